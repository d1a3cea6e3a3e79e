"""Keypoints of detectors: joints and landmarks under the detectors' names, in their order."""

import numpy as np
import pytest
import torch
from synthetic import synthetic_body

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body

COCO = (
    "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow "
    "right_elbow left_wrist "
    "right_wrist left_hip right_hip left_knee right_knee left_ankle right_ankle"
).split()  # as COCO's annotations list them


def test_the_conventions_are_the_detectors_own():
    assert list(CONVENTIONS["coco17"]) == COCO
    openpose = CONVENTIONS["openpose25"]
    assert len(openpose) == 25 and openpose[8] == "mid_hip" and openpose[19] == "left_big_toe"
    assert openpose[24] == "right_heel"
    assert set(COCO) < set(openpose)
    body25b, halpe = CONVENTIONS["body25b"], CONVENTIONS["halpe26"]
    assert list(body25b[:17]) == list(halpe[:17]) == COCO
    assert body25b[17:] == (
        *("upper_neck", "head_top", "left_big_toe", "left_small_toe", "left_heel"),
        *("right_big_toe", "right_small_toe", "right_heel"),
    )
    assert halpe[17:22] == ("head_top", "neck", "mid_hip", "left_big_toe", "right_big_toe")
    assert CONVENTIONS["wholebody23"] == (*COCO, *body25b[19:])


@pytest.mark.parametrize("joints", ["smpl", "smplx"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_keypoints_are_where_a_person_has_them(convention, joints):
    body = load_body("default", joints=joints)
    pose = np.zeros((2, body.num_joints, 3))
    pose[1, body.joint_names.index("left_elbow"), 1] = -1.0
    surface = body([0.5], pose, [0.1, 0, 0])
    points = body.keypoints(convention, surface)
    named = dict(zip(CONVENTIONS[convention], points[0], strict=True))
    assert points.shape == (2, len(named), 3)
    joint = dict(zip(body.joint_names, surface.joints[0], strict=True))
    assert np.array_equal(named["left_knee"], joint["left_knee"])
    assert named["left_eye"][1] > named["nose"][1] > joint["neck"][1]
    assert named["nose"][2] > named["left_eye"][2] > named["left_ear"][2]
    for name, point in named.items():
        if name.startswith("left_"):
            other = named[name.replace("left_", "right_")]
            assert (
                point[0] > 0.1 > other[0] and np.abs(point - other)[1:].max() < 2e-3
            )  # mirrored about x = 0.1
    if convention == "openpose25":
        assert np.allclose(named["neck"], (joint["left_shoulder"] + joint["right_shoulder"]) / 2)
        assert named["left_heel"][2] < named["left_ankle"][2] < named["left_big_toe"][2]
    moved = np.abs(points[1] - points[0]).max(1) > 1e-9
    hand = [f"left_{part}" for part in ("wrist", "pinky", "index", "thumb")]
    below = [name for name in named if name in hand]
    assert [name for name, far in zip(named, moved, strict=True) if far] == below
    full = body.full.keypoints(convention, body.full([0.5], pose, [0.1, 0, 0]))
    assert np.abs(full - points).max() < 1e-6
    betas, turns, place = (
        torch.tensor(value, dtype=torch.float64) for value in ([0.5], pose, [0.1, 0, 0])
    )
    tensors = body.keypoints(convention, body(betas, turns, place))
    assert torch.is_tensor(tensors) and np.abs(tensors.numpy() - points).max() < 1e-9


def test_what_a_body_lacks_is_said():
    body = synthetic_body()
    with pytest.raises(
        HabitusError, match="neither a joint nor a landmark 'nose_tip', where coco17 has nose"
    ):
        body.keypoints("coco17", body())
    with pytest.raises(
        HabitusError, match="keypoints 'coco'; expected one of coco17, openpose25, body25b"
    ):
        body.keypoints("coco", body())
    with pytest.raises(HabitusError, match="evaluate it at all its vertices"):
        body.keypoints("coco17", body(vertices=[1, 2]))
