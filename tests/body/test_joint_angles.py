"""Joint angles: a planted flexion comes back under its name, with its sign, on its side; the rest
stays zero.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_fit import tube_body

from habitus.body.joint_angles import joint_angles

BODY = tube_body()
REST = np.zeros(BODY.num_betas)
X, Y, Z = np.eye(3)


def angles(**turns):
    pose = np.zeros((1, BODY.num_joints, 3))
    for name, (axis, degrees) in turns.items():
        pose[0, BODY.joint_names.index(name)] = np.radians(degrees) * axis
    return {
        (name, side): values[0]
        for name, sides in joint_angles(BODY, REST, pose).items()
        for side, values in sides.items()
    }


def way(joint: str, child: str, turn: tuple) -> np.ndarray:
    """Where a bone points in body space after its joint has turned."""
    rest = BODY.rest_joints(REST)
    bone = rest[BODY.joint_names.index(child)] - rest[BODY.joint_names.index(joint)]
    return Rotation.from_rotvec(np.radians(turn[1]) * turn[0]).apply(bone) - bone


@pytest.mark.parametrize(
    ("joint", "child", "turn", "name", "toward"),
    [
        ("hip", "knee", (-X, 40), "hip flexion", Z),  # the knee comes forward
        ("knee", "ankle", (X, 60), "knee flexion", -Z),  # the heel goes back
        ("ankle", "foot", (-X, 15), "ankle dorsiflexion", Y),  # the toes come up
    ],
)
@pytest.mark.parametrize("side", ["left", "right"])
def test_flexion_is_what_its_name_says(side, joint, child, turn, name, toward):
    assert way(f"{side}_{joint}", f"{side}_{child}", turn) @ toward > 0
    found = angles(**{f"{side}_{joint}": turn})
    assert found.pop((name, side)) == pytest.approx(turn[1])
    others = {
        key: v for key, v in found.items() if key[0] not in ("shoulder elevation", "elbow flexion")
    }
    assert len(others) == 14 and np.abs(list(others.values())).max() < 1e-9


@pytest.mark.parametrize(("side", "outward"), [("left", 1), ("right", -1)])
def test_abduction_and_rotation_are_mirrored(side, outward):
    assert way(f"{side}_hip", f"{side}_knee", (outward * Z, 25)) @ (outward * X) > 0
    assert angles(**{f"{side}_hip": (outward * Z, 25)})["hip abduction", side] == pytest.approx(25)
    assert angles(**{f"{side}_hip": (-outward * Y, 20)})[
        "hip internal rotation", side
    ] == pytest.approx(20)


def test_trunk_and_head():
    found = angles(spine1=(X, 10), spine3=(X, 20), head=(Y, 30), neck=(X, 5))
    assert found["trunk flexion", ""] == pytest.approx(30)
    assert found["head turn to the left", ""] == pytest.approx(30) and found[
        "head flexion", ""
    ] == pytest.approx(5)
    assert angles(spine2=(-Z, 12))["trunk bending to the left", ""] == pytest.approx(12)


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_arms(side, sign):
    rest = angles()
    assert (
        rest["shoulder elevation", side] == pytest.approx(90, abs=2)
        and rest["elbow flexion", side] < 3
    )
    hanging = angles(**{f"{side}_shoulder": (Z, -sign * 70), f"{side}_elbow": (Y, -sign * 50)})
    assert hanging["shoulder elevation", side] == pytest.approx(
        rest["shoulder elevation", side] - 70, abs=0.1
    )
    assert hanging["elbow flexion", side] == pytest.approx(50, abs=3)


def test_a_whole_turn_is_no_jump():
    pose = np.zeros((50, BODY.num_joints, 3))
    pose[:, BODY.joint_names.index("left_hip"), 0] = np.radians(np.linspace(-100, -260, 50))
    found = joint_angles(BODY, REST, pose)["hip flexion"]["left"]
    assert np.abs(np.diff(found)).max() < 5 and np.abs(np.median(found)) <= 180


def test_what_a_body_lacks_is_left_out():
    names = tuple("tail" if name == "left_knee" else name for name in BODY.joint_names)
    found = joint_angles(replace(BODY, joint_names=names), REST, np.zeros((2, BODY.num_joints, 3)))
    assert set(found["knee flexion"]) == {"right"} and set(found["ankle dorsiflexion"]) == {"right"}
    strange = replace(BODY, joint_names=tuple(f"j{k}" for k in range(24)))
    assert joint_angles(strange, REST, np.zeros((2, 24, 3))) == {}
