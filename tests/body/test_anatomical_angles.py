"""Anatomical angles against planted turns: what is put in about an anatomical axis comes out under
its name, left is the mirror of right, and the laboratory's axes follow the way.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.anatomical_angles import CARRIERS, anatomical_angles, segment_rotations
from habitus.body.anatomy import SACRUM, Anatomy
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.jobs.anatomy import angles
from habitus.rotations import up_rotation

BODY = hb.load_body("female")
NAMES = BODY.joint_names
BETAS = np.zeros(BODY.num_betas)
FRAMES = 7
JOINTS = {  # upper, lower segment, the first two and third angle's names
    "hip": ("pelvis", "thigh", ("hip_flexion", "hip_adduction", "hip_internal_rotation")),
    "knee": ("thigh", "shank", ("knee_flexion", "knee_adduction", "knee_internal_rotation")),
    "ankle": (
        "shank_ankle",
        "foot",
        ("ankle_dorsiflexion", "ankle_inversion", "ankle_internal_rotation"),
    ),
    "elbow": ("upper_arm", "forearm", ("elbow_flexion", "elbow_carrying_angle", "elbow_pronation")),
}


def moving(pose: np.ndarray, trans: np.ndarray | None = None, up: str = "+y") -> BodyMotion:
    return BodyMotion(
        BODY, BETAS, pose, np.zeros((len(pose), 3)) if trans is None else trans, 100.0, up
    )


def random_pose(seed: int, scale: float = 0.25) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.zeros((FRAMES, len(NAMES), 3))
    pose[:, :22] = scale * rng.normal(size=(22, 3)) + 0.02 * rng.normal(
        size=(FRAMES, 22, 3)
    ).cumsum(0)
    pose[:, 0] *= 0.3
    return pose


def other_side(name: str) -> str:
    swap = {"left": "right", "right": "left"}
    return "_".join(swap.get(part, part) for part in name.split("_"))


@pytest.mark.parametrize("joint", list(JOINTS))
@pytest.mark.parametrize("side", ["left", "right"])
def test_planted_turns_come_out_under_their_names(joint, side):
    """P'D = Rz(a) Rx(b) Ry(c), made with the frames at rest, in any pose of the other joints."""
    anatomy = Anatomy.of(BODY, BETAS)
    rng = np.random.default_rng(3)
    planted = np.degrees(0.4 * rng.normal(size=(FRAMES, 3)))
    upper, lower, names = JOINTS[joint]
    frames = [
        anatomy.frame(name if name == "pelvis" else f"{side}_{name}") for name in (upper, lower)
    ]
    sign = np.array([-1.0 if joint == "knee" else 1.0, *[-1.0 if side == "left" else 1.0] * 2])
    turn = Rotation.from_euler("ZXY", planted * sign, degrees=True)
    pose = random_pose(1)
    at = NAMES.index(f"{side}_{CARRIERS[lower]}")
    chain = Rotation.from_matrix(frames[0]) * turn * Rotation.from_matrix(frames[1]).inv()
    pose[:, at] = chain.as_rotvec()
    table = anatomical_angles(moving(pose), anatomy, "isb")
    for k, name in enumerate(names):
        got = table[f"{side}_{name}"]
        np.testing.assert_allclose((got - planted[:, k] + 180) % 360 - 180, 0.0, atol=1e-9)


@pytest.mark.parametrize("convention", ["isb", "pig"])
def test_left_is_the_mirror_of_right(convention):
    """On a body whose landmarks are mirror images, in mirrored poses."""
    pose = random_pose(2)
    other = pose.copy()
    for k, name in enumerate(NAMES):
        twin = other_side(name)
        other[:, NAMES.index(twin)] = pose[:, k] * [1.0, -1.0, -1.0]
    anatomy = Anatomy.of(BODY, BETAS)
    even = {}
    for name, place in anatomy.landmarks.items():
        twin = other_side(name)
        even[name] = 0.5 * (place + anatomy.landmarks[twin] * [-1.0, 1.0, 1.0])
    joints = {}
    for name, place in anatomy.joints.items():
        twin = other_side(name)
        joints[name] = 0.5 * (place + anatomy.joints[twin] * [-1.0, 1.0, 1.0])
    anatomy = replace(anatomy, landmarks=even, joints=joints)
    ours = anatomical_angles(moving(pose), anatomy, convention)
    theirs = anatomical_angles(moving(other), anatomy, convention)
    checked = 0
    for name in ours.names:
        if name.startswith("left_"):
            np.testing.assert_allclose(
                ours[name], theirs["right_" + name[5:]], atol=1e-7, err_msg=name
            )
            checked += 1
    assert checked >= 14


def test_signs_read_as_a_clinician_reads_them():
    """Somebody who bends hip, knee and elbow, lifts the toes, raises an arm, and leans forward."""
    pose = np.zeros((2, len(NAMES), 3))
    turns = {
        "left_hip": (-40, 0, 0), "left_knee": (50, 0, 0), "right_ankle": (-15, 0, 0), "pelvis": (10, 0, 0),
        "left_shoulder": (0, 0, -80), "right_shoulder": (0, 0, 80), "left_elbow": (0, -60, 0),
    }  # fmt: skip
    rest = anatomical_angles(moving(pose), Anatomy.of(BODY, BETAS), "isb")
    for joint, turn in turns.items():
        pose[:, NAMES.index(joint)] = np.radians(turn)
    table = anatomical_angles(moving(pose), Anatomy.of(BODY, BETAS), "isb")
    change = {name: table[name][0] - rest[name][0] for name in table.names}
    assert abs(change["left_hip_flexion"] - 40) < 3 and abs(change["left_knee_flexion"] - 50) < 3
    assert abs(change["right_ankle_dorsiflexion"] - 15) < 3
    assert abs(change["pelvis_anterior_tilt"] - 10) < 1
    assert abs(rest["left_shoulder_elevation"][0] - 85) < 15
    assert table["left_shoulder_elevation"][0] < 30 and table["right_shoulder_elevation"][0] < 30
    assert change["left_elbow_flexion"] > 40


@pytest.mark.parametrize("up", ["+y", "+z", "-x"])
def test_the_laboratory_follows_the_way(up):
    """A walk in any direction of any world gives the same angles of the pelvis."""
    pose = random_pose(4)
    trans = np.linspace(0, 2, FRAMES)[:, None] * [0.1, 0.0, 1.0]
    reference = anatomical_angles(moving(pose, trans), Anatomy.of(BODY, BETAS), "pig")
    upright = up_rotation(up).T
    turn = Rotation.from_matrix(upright) * Rotation.from_euler("y", 180, degrees=True)
    turned = pose.copy()
    turned[:, 0] = (turn * Rotation.from_rotvec(pose[:, 0])).as_rotvec()
    table = anatomical_angles(moving(turned, turn.apply(trans), up), Anatomy.of(BODY, BETAS), "pig")
    np.testing.assert_allclose(table.values, reference.values, atol=1e-7)


def test_markers_on_landmarks_take_their_place():
    anatomy = Anatomy.of(BODY, BETAS)
    shift = np.array([0.0, 0.01, 0.02])
    place = anatomy.landmarks["left_knee_lateral"] + shift
    own = Anatomy.of(BODY, BETAS, {"left_knee_lateral": ("LKNE", place), "nothing": ("X", place)})
    assert own.sources == {"left_knee_lateral": "LKNE"}
    np.testing.assert_array_equal(own.landmarks["left_knee_lateral"], place)
    axis = anatomy.landmarks["left_knee_lateral"] - anatomy.landmarks["left_knee_medial"]
    axis /= np.linalg.norm(axis)
    moved = own.landmarks["left_knee_medial"] - anatomy.landmarks["left_knee_medial"]
    np.testing.assert_allclose(moved, shift - axis * (axis @ shift), atol=1e-12)
    sacral = Anatomy.of(BODY, BETAS, {SACRUM: ("SACR", place)})
    np.testing.assert_array_equal(sacral.landmarks[SACRUM], place)


def test_frames_are_rotations_with_the_axes_of_isb():
    anatomy = Anatomy.of(BODY, BETAS)
    turns = segment_rotations(
        moving(np.zeros((1, len(NAMES), 3))), anatomy, "isb", np.zeros((1, len(NAMES), 3))
    )
    for name, turn in turns.items():
        frame = turn.as_matrix()[0]
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) > 0.999
        if not any(part in name for part in ("arm", "hand")):  # which point sideways at rest
            assert frame[2, 0] > 0.9 and frame[1, 1] > 0.9 and frame[0, 2] < -0.9, name


def test_conventions_and_bodies_that_are_unknown_are_refused():
    with pytest.raises(HabitusError, match="expected one of isb, pig, opensim"):
        angles(moving(np.zeros((1, len(NAMES), 3))), "vicon")
    bare = replace(BODY, landmarks={})
    with pytest.raises(HabitusError, match="no landmark"):
        Anatomy.of(bare, BETAS)
    table = angles(moving(random_pose(5)), "opensim")
    assert "hip_flexion_r" in table.names and "pelvis_tx" not in table.names
    with pytest.raises(KeyError):
        table["nothing"]
