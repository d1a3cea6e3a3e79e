"""The shipped bodies keep their promises: meshes, rig, twist, shape space, landmarks, size and load time."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from habitus import load_body
from habitus.rotations import matrix_from_rotvec

ASSETS = Path(__file__).resolve().parents[2] / "src" / "habitus" / "assets"
FINGERS = ("index", "middle", "pinky", "ring", "thumb")
JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "jaw", "left_eye_smplhf",
    "right_eye_smplhf", *(f"{side}_{f}{k}" for side in ("left", "right") for f in FINGERS for k in (1, 2, 3)),
)  # fmt: skip
PARENTS = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15,
    20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38,
    21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53,
)  # fmt: skip
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
    "big_toe", "toe_tip", "little_toe", "ring_tip", "thumb_cmc", "thumb_mcp", "thumb_ip",
    *(f"{f}_{j}" for f in ("index", "middle", "ring", "pinky") for j in ("mcp", "pip", "dip")),
)  # fmt: skip


EYEBALL = 72


@pytest.fixture(scope="module", params=("female", "male", "neutral"))
def path(request: pytest.FixtureRequest) -> Path:
    return ASSETS / "bodies" / f"{request.param}.npz"


@pytest.fixture(scope="module")
def body(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="module")
def regressor(body: dict[str, np.ndarray]) -> np.ndarray:
    table = np.zeros((len(JOINTS), len(body["v_template"])))
    table[body["joint_regressor_rows"], body["joint_regressor_cols"]] = body["joint_regressor_values"]
    return table


def _place(body: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return dict(zip(body["landmark_names"].tolist(), body["v_template"][body["landmark_vertices"]], strict=True))


def test_file_is_small_quick_and_free(path: Path, body: dict[str, np.ndarray]) -> None:
    assert path.stat().st_size < 8e6
    assert str(body["license"]) == "CC0-1.0" and str(body["version"]).startswith("2.")
    assert (ASSETS / "LICENSE").is_file()

    def seconds() -> float:
        start = time.process_time()
        load_body(path.stem)
        return time.process_time() - start

    assert min(seconds() for _ in range(3)) < 0.3


@pytest.mark.parametrize("level", ("full", "coarse"))
def test_mesh_is_closed_outward_and_symmetric(body: dict[str, np.ndarray], level: str) -> None:
    """A skin like a sphere and two eyeballs like spheres, at either level of detail."""
    vertices, faces = _mesh(body, level)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges), "an edge is used twice in the same direction"
    assert all((b, a) in there for a, b in there), "an edge has one triangle only"
    assert len(vertices) - len(edges) // 2 + len(faces) == 2 * 3, "not three spheres"
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert 0.05 < (a * np.cross(b, c)).sum() / 6 < 0.10
    place = {tuple(row): k for k, row in enumerate(vertices.tolist())}
    mirror = np.array([place[tuple(row)] for row in (vertices * [-1, 1, 1] + 0.0).tolist()])
    turned = {tuple(sorted(face)) for face in mirror[faces].tolist()}
    assert turned == {tuple(sorted(face)) for face in faces.tolist()}


def _mesh(body: dict[str, np.ndarray], level: str) -> tuple[np.ndarray, np.ndarray]:
    vertices = body["v_template"].astype(float)
    return (vertices, body["faces"]) if level == "full" else (vertices[body["coarse_vertices"]], body["coarse_faces"])


def test_full_mesh_keeps_quads_texture_and_hidden_linings(body: dict[str, np.ndarray]) -> None:
    vertices, quads, mirror = body["v_template"].astype(float), body["quads"], body["mirror"]
    assert len(vertices) == 13380 + 2 * EYEBALL and len(quads) == 13378 + 2 * 70
    assert np.array_equal(mirror[mirror], np.arange(len(vertices)))
    np.testing.assert_allclose(vertices[mirror], vertices * [-1, 1, 1], atol=1e-6)
    corners = {tuple(sorted(face)) for face in body["faces"].tolist()}
    assert len(corners) == 2 * len(quads)
    for a, b, c, d in quads[::97].tolist():
        first = {tuple(sorted(t)) for t in ((a, b, c), (a, c, d))}
        assert first <= corners or {tuple(sorted(t)) for t in ((a, b, d), (b, c, d))} <= corners
    assert body["quad_uv"].shape == quads.shape and body["quad_uv"].max() == len(body["uv"]) - 1
    assert body["uv"].min() >= 0 and body["uv"].max() <= 1
    lining = vertices[quads[body["hidden_quads"]]].mean(1)
    chin, top = _place(body)["chin"], _place(body)["head_top"]
    assert body["hidden_quads"].sum() == 398 + 2 * 293
    assert chin[1] < lining[:, 1].min() and lining[:, 1].max() < top[1], "linings lie in the head"


def test_coarse_mesh_has_hands_landmarks_and_what_tells_joints(body: dict[str, np.ndarray]) -> None:
    coarse = body["coarse_vertices"]
    assert (np.diff(coarse) > 0).all() and 7000 <= len(coarse) <= 8000
    assert set(body["landmark_vertices"].tolist()) <= set(coarse.tolist())
    assert set(body["joint_regressor_cols"].tolist()) <= set(coarse.tolist())
    strongest = np.array(JOINTS)[body["skinning_index"][coarse, 0]]
    for side in ("left_", "right_"):
        assert (
            sum(n.startswith(side) and n.removeprefix(side).startswith((*FINGERS, "wrist")) for n in strongest) >= 750
        )


def test_twist_is_shared_and_bending_adds_nothing(body: dict[str, np.ndarray], regressor: np.ndarray) -> None:
    """Of a pure swing across the limb the pose blend shapes make nothing; of a twist they make centimetres."""
    drivers = [JOINTS[k] for k in body["posedirs_joints"]]
    assert drivers == [f"{side}_{part}" for part in ("hip", "shoulder", "wrist") for side in ("left", "right")]
    joints = dict(zip(JOINTS, regressor @ body["v_template"], strict=True))
    ends = {"hip": ("hip", "knee"), "shoulder": ("shoulder", "elbow"), "wrist": ("elbow", "wrist")}
    shapes = body["posedirs"].astype(float).reshape(len(body["v_template"]), 3, len(drivers), 3, 3)
    for k, name in enumerate(drivers):
        side, _, part = name.partition("_")
        upper, lower = (joints[f"{side}_{end}"] for end in ends[part])
        axis = (lower - upper) / np.linalg.norm(lower - upper)
        across = np.cross(axis, [0.3, 0.5, 0.8])
        across /= np.linalg.norm(across)

        def moved(turn: np.ndarray, k: int = k) -> float:
            rotation = matrix_from_rotvec(turn) - np.eye(3)
            return float(np.abs(np.einsum("vcij,ij->vc", shapes[:, :, k], rotation)).max())

        assert max(moved(angle * across) for angle in (-1.2, 0.6, 1.4)) < 3e-4
        assert 0.01 < moved(np.radians(80) * axis) < 0.12


def test_rig_is_smpls(body: dict[str, np.ndarray]) -> None:
    assert tuple(body["joint_names"].tolist()) == JOINTS
    assert tuple(body["parents"].tolist()) == PARENTS
    value, index = body["skinning_value"], body["skinning_index"]
    assert value.shape == index.shape == (len(body["v_template"]), 4)
    np.testing.assert_allclose(value.sum(1), 1, atol=1e-6)
    assert value.min() >= 0
    assert len(np.unique(index[:, 0])) == len(JOINTS), "some joint is no vertex's strongest"
    twin = np.array(
        [JOINTS.index(n.replace("left_", "#").replace("right_", "left_").replace("#", "right_")) for n in JOINTS]
    )
    dense = np.zeros((len(value), len(JOINTS)))
    np.put_along_axis(dense, index.astype(np.int64), value, 1)
    np.testing.assert_allclose(dense[body["mirror"]][:, twin], dense, atol=1e-6)


def test_rest_pose_is_a_t_pose(body: dict[str, np.ndarray], regressor: np.ndarray) -> None:
    joints = dict(zip(JOINTS, regressor @ body["v_template"], strict=True))
    np.testing.assert_allclose(regressor.sum(1), 1, atol=1e-5)
    assert np.linalg.norm(joints["pelvis"]) < 0.01
    for name in ("elbow", "wrist"):
        arm = joints["left_" + name] - joints["left_shoulder"]
        assert arm[0] > 0.2 and np.abs(arm[1:]).max() < 0.02
    assert abs(joints["left_ankle"][0] - joints["left_hip"][0]) < 0.05
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


def test_joints_lie_where_bodies_bend(body: dict[str, np.ndarray], regressor: np.ndarray) -> None:
    joints, mark = dict(zip(JOINTS, regressor @ body["v_template"], strict=True)), _place(body)
    for joint, ends in (("elbow", "elbow"), ("knee", "knee"), ("ankle", "ankle")):
        middle = 0.5 * (mark[f"left_{ends}_lateral"] + mark[f"left_{ends}_medial"])
        assert np.linalg.norm(joints["left_" + joint] - middle) < 0.008, joint
    front, back = mark["left_asis"], mark["left_psis"]  # Harrington et al. 2007
    width, depth = 2 * front[0], np.linalg.norm((front - back)[1:])
    forward = np.array([0, *(front - back)[1:]]) / depth
    up = np.array([0, forward[2], -forward[1]])
    hip = front * [0, 1, 1] - (0.24 * depth + 0.0099) * forward - (0.30 * width + 0.0109) * up
    assert np.linalg.norm(joints["left_hip"] - hip - [0.33 * width + 0.0073, 0, 0]) < 0.015
    eye = body["v_template"][-2 * EYEBALL : -EYEBALL].mean(0)
    assert np.linalg.norm(joints["left_eye_smplhf"] - eye) < 0.003


def test_shape_space_spans_people(body: dict[str, np.ndarray]) -> None:
    dirs = body["shapedirs"].astype(float)
    assert dirs.shape[-1] >= 20
    assert np.isfinite(dirs).all()
    top = _index(body, "head_top")
    sole = int(body["v_template"][:, 1].argmin())
    stature = body["v_template"][top, 1] - body["v_template"][sole, 1]
    gain = dirs[top, 1] - dirs[sole, 1]
    assert 1.58 < stature < 1.80
    for wanted in (0.88 * stature, 1.12 * stature):
        betas = gain * (wanted - stature) / (gain @ gain)
        assert np.abs(betas).max() <= 3.5


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
        assert abs((place[name][1] - floor) / stature - share) < 0.014, name


def _index(body: dict[str, np.ndarray], name: str) -> int:
    return int(body["landmark_vertices"][body["landmark_names"].tolist().index(name)])
