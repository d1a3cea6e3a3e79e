"""Hand poses: angles as a clinician measures them, mirrored sides, tips that meet."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import habitus as hb
from habitus.body.hands import FINGERS, HAND_POSES, HandPose, hand_pose
from habitus.mesh.intersections import intersecting_pairs

CUTS = {"flat": 0, "relaxed": 0, "fist": 340, "grip": 25, "pinch": 6}
"""Pairs of triangles that may cut each other, of both hands, beyond those at rest."""
ANGLES = st.tuples(*(st.floats(-15.0, 95.0) for _ in range(3)))


@cache
def body():
    return hb.load_body("default", joints="smplh")


def joints(pose):
    return dict(zip(body().joint_names, np.asarray(body()(pose=pose).joints), strict=True))


def unit(vector):
    return vector / np.linalg.norm(vector)


def palm_of(at, side):
    along = 0.5 * (at[f"{side}_index1"] + at[f"{side}_pinky1"]) - at[f"{side}_wrist"]
    across = at[f"{side}_index1"] - at[f"{side}_pinky1"]
    return unit(np.cross(along, across)) * (1.0 if side == "left" else -1.0)


@pytest.mark.parametrize("side", ["left", "right"])
@settings(max_examples=15, deadline=None)
@given(ANGLES, ANGLES)
def test_angles_are_measured_from_a_straight_finger_in_the_palms_plane(side, index, ring):
    at = joints(hand_pose(body(), HandPose(index=index, ring=ring)))
    palm = palm_of(at, side)
    for finger, wanted in (("index", index), ("ring", ring), ("middle", (0.0, 0.0, 0.0))):
        first, second, third = (at[f"{side}_{finger}{k}"] for k in (1, 2, 3))
        bones = [unit(second - first), unit(third - second)]
        lift = np.degrees(np.arcsin(np.clip(bones[0] @ palm, -1.0, 1.0)))
        expected = np.degrees(np.arcsin(np.sin(np.radians(wanted[0]))))
        assert abs(lift - expected) < 5.0  # a finger's bones lie up to 4 degrees beside its plane
        bend = np.degrees(np.arccos(np.clip(bones[0] @ bones[1], -1.0, 1.0)))
        assert abs(bend - abs(wanted[1])) < 5.0


@pytest.mark.parametrize("name", HAND_POSES)
def test_sides_are_mirror_images(name):
    found = hand_pose(body(), name)
    for joint, turn in found.items():
        if joint.startswith("left"):
            other = found[joint.replace("left", "right")]
            np.testing.assert_allclose(turn, other * [1.0, -1.0, -1.0], atol=0.01)


def test_half_a_pose_and_none():
    whole, half, none = (hand_pose(body(), "fist", amount=part) for part in (1.0, 0.5, 0.0))
    for joint, turn in whole.items():
        np.testing.assert_allclose(half[joint], 0.5 * turn)
        assert not none[joint].any()
    assert set(hand_pose(body(), "fist", ("left",))) == {j for j in whole if j[0] == "l"}


def tips(pose, side):
    """Tips of the fingers: the vertices that lie farthest from the wrist at rest."""
    rest = body().rest_vertices()
    surface = np.asarray(body()(pose=pose).vertices)
    wrist = body().rest_joints()[body().joint_names.index(f"{side}_wrist")]
    found = {}
    for finger in (*FINGERS, "thumb"):
        weight = body().skinning_weights[:, body().joint_names.index(f"{side}_{finger}3")]
        skin = np.flatnonzero(weight > 0.5)
        far = skin[np.argsort(-np.linalg.norm(rest[skin] - wrist, axis=1))[:8]]
        found[finger] = surface[far].mean(axis=0)
    return found


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_fist_is_closed_and_a_pinch_meets(side):
    at = joints({})
    middle = 0.5 * (at[f"{side}_wrist"] + at[f"{side}_middle1"])
    flat = tips(hand_pose(body(), "flat"), side)
    fist = tips(hand_pose(body(), "fist"), side)
    for finger in FINGERS:
        far, near = (np.linalg.norm(each[finger] - middle) for each in (flat, fist))
        assert near < 0.06 < 0.09 < far
    pinch = tips(hand_pose(body(), "pinch"), side)
    assert np.linalg.norm(pinch["index"] - pinch["thumb"]) < 0.025


@pytest.mark.parametrize("name", HAND_POSES)
def test_few_triangles_cut_each_other(name):
    cuts = [
        len(intersecting_pairs(np.asarray(body()(pose=pose).vertices), body().faces))
        for pose in ({}, hand_pose(body(), name))
    ]
    assert cuts[1] - cuts[0] <= CUTS[name]


def test_a_body_without_fingers_and_unknown_names_are_refused():
    with pytest.raises(hb.HabitusError, match="expected a body with fingers"):
        hand_pose(hb.load_body("default"), "fist")
    with pytest.raises(hb.HabitusError, match="expected one of flat, relaxed, fist"):
        hand_pose(body(), "wave")
    with pytest.raises(hb.HabitusError, match="expected left or right"):
        hand_pose(body(), "fist", ("both",))
