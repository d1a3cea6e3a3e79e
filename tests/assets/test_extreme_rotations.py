"""What the shipped bodies' pose blend shapes do where each joint alone turns far about each axis,
also about those that no pose was simulated for.

The goal is an offset of at most 40 mm and a body within 0.3 l of its volume at rest. `MISSES` are
the rotations that miss it, with what they have: an improvement or a relapse changes the table.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from habitus.body.joint_layouts import SMPLX
from habitus.body.pose_features import pose_coefficients
from habitus.io.models.bodies import load_body
from habitus.mesh.intersections import intersecting_pairs
from habitus.rotations import matrix_from_rotvec

LARGEST_OFFSET = 40.0  # mm
LARGEST_CHANGE = 0.3  # litres
ANGLES = {  # degrees; 60 for the limbs' joints
    "spine1": 30, "spine2": 30, "spine3": 30, "collar": 30, "neck": 40, "head": 40,
}  # fmt: skip
TRAINED = {  # simulated to about this angle: flesh does move so far, or so much volume is lost
    ("hip", "x", -60): (47, 0.3),
    ("hip", "y", -60): (42, 0.4),
    ("hip", "y", 60): (40, 0.6),
    ("hip", "z", 60): (38, 0.4),
    ("spine1", "z", -30): (30, 0.4),
    ("spine2", "x", -30): (20, 0.4),
    ("spine3", "x", 30): (46, 0.4),
    ("shoulder", "x", -60): (62, 0.1),
    ("shoulder", "x", 60): (55, 0.2),
    ("shoulder", "y", -60): (48, 0.1),
    ("shoulder", "z", -60): (46, 0.2),
    ("shoulder", "z", 60): (46, 0.3),
}
EXTRAPOLATED = {  # a hip far back, legs crossed sideways, a trunk bent back, a lowered collar
    ("hip", "x", 60): (38, 1.1),
    ("hip", "z", -60): (39, 0.4),
    ("knee", "x", -60): (34, 0.35),
    ("ankle", "x", -60): (28, 0.45),
    ("ankle", "y", 60): (6, 0.35),
    ("spine1", "x", -30): (29, 0.45),
    ("spine2", "z", -30): (26, 0.4),
    ("spine3", "z", -30): (23, 0.6),
    ("collar", "z", -30): (28, 0.85),
}
MISSES = TRAINED | EXTRAPOLATED
ROTATIONS = [
    (name.removeprefix("left_"), axis, sign * ANGLES.get(name.removeprefix("left_"), 60))
    for name in SMPLX.joint_names[1:22]
    if not name.startswith("right_")
    for axis in "xyz"
    for sign in (-1, 1)
    if name.startswith("left_") or axis == "x" or sign < 0  # of the trunk, one side stands for both
]
TWISTS = [
    (joint, axis, degrees)
    for joint, axis, angles in (
        ("elbow", "x", (60, 90)),
        ("knee", "y", (60,)),
        ("ankle", "y", (60,)),
    )
    for angle in angles
    for degrees in (-angle, angle)
]


@pytest.fixture(scope="module", params=("female", "male", "neutral"))
def body(request):
    """The full level with all joints."""
    return load_body(request.param, detail="full", joints="smplx")


def posed(body, joint: str, axis: str, degrees: float) -> tuple[np.ndarray, float]:
    """Vertices (V, 3) with one joint turned, and the longest offset of its blend shapes (mm)."""
    name = joint if joint in body.joint_names else f"left_{joint}"
    turn = np.radians(degrees) * np.eye(3)["xyz".index(axis)]
    pose = np.zeros((body.num_joints, 3))
    pose[body.joint_names.index(name)] = turn
    driven = (body.features, body.hinges, 0, body.drivers)
    known = pose_coefficients(*driven, pose, matrix_from_rotvec(pose), np.zeros(body.num_betas))
    offsets = body.pose_directions @ known
    return np.asarray(body(pose={name: turn}).vertices), 1e3 * np.linalg.norm(offsets, axis=1).max()


def litres(body, vertices: np.ndarray) -> float:
    """Signed volume."""
    a, b, c = vertices[body.faces].transpose(1, 0, 2)
    return 1e3 * float((a * np.cross(b, c)).sum()) / 6


def test_every_joint_turns_far_about_every_axis_without_harm(body) -> None:
    rest = litres(body, np.asarray(body().vertices))
    for rotation in ROTATIONS:
        offset, change = MISSES.get(rotation, (LARGEST_OFFSET, LARGEST_CHANGE))
        vertices, longest = posed(body, *rotation)
        assert longest <= offset, rotation
        assert abs(litres(body, vertices) - rest) <= change, rotation


def test_the_misses_are_rotations_that_were_measured() -> None:
    assert set(MISSES) <= set(ROTATIONS)
    for rotation, (offset, change) in MISSES.items():
        assert offset > LARGEST_OFFSET - 1 or change >= LARGEST_CHANGE, rotation


@pytest.mark.parametrize(("joint", "axis", "degrees"), TWISTS)
def test_a_twist_tears_nothing(body, joint, axis, degrees) -> None:
    """No torn armpit: a twist of elbow, knee or ankle moves no flesh far, keeps the volume that
    skinning keeps, and cuts hardly more skin. Twists of elbows to 80 and of knees to 30 degrees are
    simulated: they keep more volume than skinning does.
    """
    plain = replace(body, posedirs=None, pose_joints=None)
    vertices, longest = posed(body, joint, axis, degrees)
    turn = np.radians(degrees) * np.eye(3)["xyz".index(axis)]
    skinned = np.asarray(plain(pose={f"left_{joint}": turn}).vertices)
    far = abs(degrees) == 90
    assert longest < (30 if joint == "elbow" else 20)
    most = 0.23 if joint == "ankle" else 0.17  # ankles turn by 20 degrees in people
    assert abs(litres(body, vertices) - litres(body, skinned)) < most
    pairs, without = (len(intersecting_pairs(v, body.faces)) for v in (vertices, skinned))
    assert pairs <= without + (20 if far else 4)  # 86 to 142 were new at 90 degrees of the elbow


def test_left_and_right_are_exact_mirror_images_and_the_midline_is_its_own(body) -> None:
    flip = np.array([-1.0, 1.0, 1.0])
    names = body.joint_names
    swap = {"left": "right", "right": "left"}
    sides = [names[joint].split("_", 1) for joint in body.pose_joints]
    partner = [
        body.pose_joints.index(names.index(f"{swap[w[0]]}_{w[1]}")) if w[0] in swap else k
        for k, w in enumerate(sides)
    ]
    blocks = body.posedirs.reshape(body.num_vertices, 3, len(partner), 9)
    image = blocks[body.mirror][:, :, partner] * flip[:, None, None]
    assert np.array_equal(image * np.outer(flip, flip).ravel(), blocks)
    shapes = body.shapedirs
    assert np.array_equal(shapes[body.mirror] * flip[:, None], shapes)
