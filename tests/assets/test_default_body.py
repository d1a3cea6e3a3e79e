"""The shipped default body keeps its promises: mesh, rig, shape space, landmarks, size and load time."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

ASSETS = Path(__file__).resolve().parents[2] / "src" / "habitus" / "assets"
BODY_FILE = ASSETS / "default_body.npz"
JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
MIDLINE = (
    "head_top", "forehead", "glabella", "sellion", "chin", "head_back", "neck_front", "c7", "t2", "t6", "t10",
    "t12", "l1", "l3", "l5", "sacrum", "jugular_notch", "sternum_mid", "xiphoid", "navel", "waist_front",
    "waist_back",
)  # fmt: skip
PAIRED = (
    "front_head", "back_head", "temple", "head_side", "mastoid", "cheek", "neck_side", "acromion",
    "clavicle_medial", "shoulder_front", "shoulder_back", "trapezius", "scapula_upper", "scapula_mid",
    "scapula_lower", "back_lower", "breast", "rib_side", "waist_side", "belly_side", "iliac_crest", "asis", "psis",
    "buttock", "trochanter", "upper_arm_high", "upper_arm", "biceps", "triceps", "elbow_lateral", "elbow_medial",
    "olecranon", "forearm", "forearm_low", "wrist_radial", "wrist_ulnar", "wrist_dorsal", "hand_back",
    "hand_radial", "hand_ulnar", "thumb_base", "thumb_tip", "index_tip", "middle_tip", "pinky_tip", "thigh_front",
    "thigh_front_low", "thigh_lateral", "thigh_lateral_low", "thigh_back", "thigh_medial", "knee_lateral",
    "knee_medial", "patella", "tibial_tuberosity", "fibula_head", "shin_front", "shank_lateral",
    "shank_lateral_high", "calf", "ankle_lateral", "ankle_medial", "heel", "heel_high", "heel_lateral",
    "heel_medial", "midfoot_top", "navicular", "mt1_head", "mt2_head", "mt5_head", "mt1_base", "mt5_base", "hallux",
    "big_toe", "toe_tip", "little_toe",
)  # fmt: skip


@pytest.fixture(scope="module")
def body() -> dict[str, np.ndarray]:
    with np.load(BODY_FILE, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="module")
def regressor(body: dict[str, np.ndarray]) -> np.ndarray:
    table = np.zeros((len(JOINTS), len(body["v_template"])))
    table[body["joint_regressor_rows"], body["joint_regressor_cols"]] = body["joint_regressor_values"]
    return table


def _place(body: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return dict(zip(body["landmark_names"].tolist(), body["v_template"][body["landmark_vertices"]], strict=True))


def test_file_is_small_quick_and_free(body: dict[str, np.ndarray]) -> None:
    assert BODY_FILE.stat().st_size < 6e6
    assert str(body["license"]) == "CC0-1.0"
    assert (ASSETS / "LICENSE").is_file()

    def seconds() -> float:
        start = time.perf_counter()
        with np.load(BODY_FILE, allow_pickle=False) as file:
            for name in file.files:
                file[name]
        return time.perf_counter() - start

    assert min(seconds() for _ in range(3)) < 0.3


def test_mesh_is_closed_outward_and_symmetric(body: dict[str, np.ndarray]) -> None:
    vertices, faces, mirror = body["v_template"].astype(float), body["faces"], body["mirror"]
    assert 7000 <= len(vertices) <= 7200 and len(vertices) != 6890
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges), "an edge is used twice in the same direction"
    assert all((b, a) in there for a, b in there), "an edge has one triangle only"
    assert len(vertices) - len(edges) // 2 + len(faces) == 2, "not a sphere"
    a, b, c = vertices[faces].transpose(1, 0, 2)
    volume = (a * np.cross(b, c)).sum() / 6
    assert 0.05 < volume < 0.10
    assert np.array_equal(mirror[mirror], np.arange(len(vertices)))
    np.testing.assert_allclose(vertices[mirror], vertices * [-1, 1, 1], atol=1e-6)
    turned = {tuple(sorted(face)) for face in mirror[faces].tolist()}
    assert turned == {tuple(sorted(face)) for face in faces.tolist()}


def test_rig_is_smpls(body: dict[str, np.ndarray]) -> None:
    assert tuple(body["joint_names"].tolist()) == JOINTS
    assert tuple(body["parents"].tolist()) == PARENTS
    value, index = body["skinning_value"], body["skinning_index"]
    assert value.shape == index.shape == (len(body["v_template"]), 4)
    np.testing.assert_allclose(value.sum(1), 1, atol=1e-6)
    assert value.min() >= 0
    assert set(body["part"].tolist()) == set(JOINTS)
    twin = np.array(
        [JOINTS.index(n.replace("left_", "#").replace("right_", "left_").replace("#", "right_")) for n in JOINTS]
    )
    dense = np.zeros((len(value), 24))
    np.put_along_axis(dense, index.astype(np.int64), value, 1)
    np.testing.assert_allclose(dense[body["mirror"]][:, twin], dense, atol=1e-6)


def test_rest_pose_is_a_t_pose(body: dict[str, np.ndarray], regressor: np.ndarray) -> None:
    joints = dict(zip(JOINTS, regressor @ body["v_template"], strict=True))
    np.testing.assert_allclose(regressor.sum(1), 1, atol=1e-5)
    assert np.linalg.norm(joints["pelvis"]) < 0.01
    for name in ("elbow", "wrist"):
        arm = joints["left_" + name] - joints["left_shoulder"]
        assert arm[0] > 0.2 and np.abs(arm[1:]).max() < 0.02
    assert abs(joints["left_ankle"][0] - joints["left_hip"][0]) < 0.04
    knee = joints["left_knee"] - joints["left_hip"], joints["left_ankle"] - joints["left_knee"]
    cosine = knee[0] @ knee[1] / np.linalg.norm(knee[0]) / np.linalg.norm(knee[1])
    assert np.degrees(np.arccos(cosine)) < 10
    assert joints["left_foot"][2] > joints["left_ankle"][2] + 0.05, "toes must point to +z"


def test_joints_follow_the_shape(body: dict[str, np.ndarray], regressor: np.ndarray) -> None:
    """Shape must not bend the rest pose: arms stay horizontal and the pelvis stays at the origin, whatever the
    betas.
    """
    rng = np.random.default_rng(0)
    betas = rng.normal(size=(20, body["shapedirs"].shape[-1]))
    bodies = body["v_template"] + np.einsum("vcb,nb->nvc", body["shapedirs"].astype(float), betas)
    joints = np.einsum("jv,nvc->njc", regressor, bodies)
    arm = joints[:, JOINTS.index("left_wrist")] - joints[:, JOINTS.index("left_shoulder")]
    assert np.degrees(np.arctan2(np.abs(arm[:, 1:]).max(1), arm[:, 0])).max() < 4
    assert np.linalg.norm(joints[:, 0], axis=1).max() < 0.02


def test_shape_space_spans_people(body: dict[str, np.ndarray]) -> None:
    dirs = body["shapedirs"].astype(float)
    assert dirs.shape[-1] >= 20
    assert np.isfinite(dirs).all()
    top = _index(body, "head_top")
    sole = int(body["v_template"][:, 1].argmin())
    stature = body["v_template"][top, 1] - body["v_template"][sole, 1]
    gain = dirs[top, 1] - dirs[sole, 1]
    assert 1.62 < stature < 1.76
    for wanted in (1.45, 2.0):
        betas = gain * (wanted - stature) / (gain @ gain)
        assert np.abs(betas).max() <= 3
    flat = dirs.reshape(-1, dirs.shape[-1])
    scale = (flat**2).sum(0)
    assert (np.diff(scale) < 0).all(), "components are not in order of variance"


def test_landmarks_are_complete_mirrored_and_in_order(body: dict[str, np.ndarray]) -> None:
    names = body["landmark_names"].tolist()
    assert len(set(names)) == len(names)
    assert set(names) == set(MIDLINE) | {f"{side}_{name}" for side in ("left", "right") for name in PAIRED}
    vertex = dict(zip(names, body["landmark_vertices"].tolist(), strict=True))
    for name in PAIRED:
        assert body["mirror"][vertex["left_" + name]] == vertex["right_" + name]
        assert body["v_template"][vertex["left_" + name], 0] > 0
    for name in MIDLINE:
        assert abs(body["v_template"][vertex[name], 0]) < 1e-6
    place = _place(body)
    spine = [
        place[n][1] for n in ["head_back", "c7", "t2", "t6", "t10", "t12", "l1", "l3", "waist_back", "l5", "sacrum"]
    ]
    front = [
        place[n][1]
        for n in (
            "glabella",
            "sellion",
            "chin",
            "neck_front",
            "jugular_notch",
            "sternum_mid",
            "xiphoid",
            "navel",
            "waist_front",
        )
    ]
    leg = [
        place["left_" + n][1]
        for n in ["iliac_crest", "asis", "trochanter", "thigh_front", "thigh_front_low", "patella", "tibial_tuberosity"]
    ]
    assert spine == sorted(spine, reverse=True)
    assert front == sorted(front, reverse=True)
    assert leg == sorted(leg, reverse=True)
    arm = [
        place["left_" + n][0]
        for n in ["acromion", "upper_arm_high", "upper_arm", "elbow_lateral", "forearm", "forearm_low", "wrist_dorsal"]
    ]
    assert arm == sorted(arm)


def test_landmarks_stand_where_the_survey_measured_them(body: dict[str, np.ndarray]) -> None:
    """Heights as shares of stature: means over both sexes of ANSUR II, 6,068 people."""
    place, floor = _place(body), body["v_template"][:, 1].min()
    stature = place["head_top"][1] - floor
    shares = {
        "c7": 0.860, "jugular_notch": 0.818, "navel": 0.602, "left_iliac_crest": 0.608, "left_trochanter": 0.516,
        "left_patella": 0.277, "left_knee_lateral": 0.283, "left_ankle_lateral": 0.040,
    }  # fmt: skip
    for name, share in shares.items():
        assert abs((place[name][1] - floor) / stature - share) < 0.012, name


def test_female_direction_separates(body: dict[str, np.ndarray]) -> None:
    assert body["female_weights"].shape == (body["shapedirs"].shape[-1],)
    assert float(body["female_accuracy"]) > 0.9


def _index(body: dict[str, np.ndarray], name: str) -> int:
    return int(body["landmark_vertices"][body["landmark_names"].tolist().index(name)])
