"""The neck twist: what skinning alone does is known, and what a bulge linear in angles or in
rotations must do.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.evaluate.neck_twist import neck_twist, neck_vertices, twist_joints, twist_pose
from habitus.io.models.bodies import load_body
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.planted_body import planted_truth

BULGE = 0.02  # m


@pytest.fixture(scope="module")
def body():
    return coarse_body(load_body("default"), 450)


def radial(body):
    """Directions (V, 3) away from the neck's axis on the neck, 0 elsewhere; and the axis."""
    joints = body.rest_joints()[list(twist_joints(body.joint_names, body.parents))]
    axis = (joints[1] - joints[0]) / np.linalg.norm(joints[1] - joints[0])
    away = body.v_template - joints[0]
    away -= (away @ axis)[:, None] * axis
    found = np.zeros_like(away)
    rows = neck_vertices([body])
    found[rows] = away[rows] / np.linalg.norm(away[rows], axis=1, keepdims=True)
    return found, axis


def bulging(body, feature: str, slopes: np.ndarray, skinning: str = "lbs"):
    """The body with a bulge of the neck that is linear in the neck joint's features."""
    out, _ = radial(body)
    k = twist_joints(body.joint_names, body.parents)[0]
    each = len(slopes)
    posedirs = np.zeros((body.num_vertices, 3, (body.num_joints - 1) * each))
    posedirs[..., (k - 1) * each : k * each] = BULGE * out[..., None] * slopes
    return replace(body, posedirs=posedirs, pose_features=feature, skinning=skinning)


def test_linear_blending_thins_and_dual_quaternions_do_not(body):
    linear, dual = neck_twist([body, replace(body, skinning="dqbs")])
    assert linear.joints == ("neck", "head") and 0.04 < linear.radius < 0.1
    middle = linear.angles.index(0)
    assert linear.girth[middle] == 1 and (np.diff(linear.girth)[:middle] > 0).all()
    np.testing.assert_allclose(linear.girth, linear.girth[::-1], rtol=1e-12)
    assert 0.03 < linear.shrink < 0.15 and linear.asymmetry < 1e-12
    np.testing.assert_allclose(dual.girth, 1, rtol=1e-9)


def test_a_bulge_linear_in_the_angle_thickens_one_side_and_thins_the_other(body):
    _, axis = radial(body)
    (found,) = neck_twist([bulging(body, "angles", axis, "dqbs")])
    np.testing.assert_allclose(
        found.girth, 1 + BULGE * np.radians(found.angles) / 2 / found.radius, rtol=1e-9
    )  # half of the turn is the neck's, half the head's
    left = np.radians(np.arange(10, 91, 10))
    np.testing.assert_allclose(found.asymmetry, BULGE * left.mean() / found.radius, rtol=1e-9)
    assert abs(found.shrink) < 1e-12


def test_a_bulge_linear_in_the_rotation_mends_both_sides(body):
    cosine = -np.eye(3).ravel() / 2  # of R - I: 1 - cos(angle)
    plain, found = neck_twist([body, bulging(body, "rotations", cosine)])
    assert found.asymmetry < 1e-12
    gain = BULGE * (1 - np.cos(np.pi / 4)) / found.radius
    assert 0.9 * gain < plain.shrink - found.shrink <= gain


def test_a_mirrored_model_of_rotations_is_symmetric(body):
    planted, plain = neck_twist([planted_truth(body, pose_shape_size=0.03), body])
    assert planted.asymmetry < 1e-9 and np.abs(planted.girth - plain.girth).max() > 1e-3


def test_positive_angles_turn_the_face_to_the_left(body):
    pose = twist_pose(body, 60.0)
    vertices = body(pose=pose).vertices
    nose = body.v_template[:, 2].copy()
    nose[body.v_template[:, 1] < 0.6] = -1.0
    assert vertices[nose.argmax(), 0] > 0.05
    np.testing.assert_allclose(np.linalg.norm(pose, axis=1).sum(), np.radians(60))


def test_joints_are_found_by_name():
    assert twist_joints(("root", "Neck_01", "x", "head"), (-1, 0, 1, 1)) == (1, 3)
    assert twist_joints(("root", "neck1", "neck2", "Head"), (-1, 0, 1, 2)) == (1, 2, 3)
    assert twist_joints(("root", "head"), (-1, 0)) == (1,)
    assert twist_joints(("head", "tail"), (-1, 0)) == ()


def test_one_joint_turns_on_the_axis_to_what_it_carries(body):
    names = tuple("skull" if name == "head" else name for name in body.joint_names)
    (found,) = neck_twist([replace(body, joint_names=names)], (-80, 80))
    assert found.joints == ("neck",) and found.asymmetry < 1e-9 and found.shrink > 0.02


def test_what_has_no_neck_is_refused(body):
    names = tuple(f"joint_{k}" for k in range(body.num_joints))
    with pytest.raises(HabitusError, match="no joint called neck"):
        neck_twist([replace(body, joint_names=names)])
    with pytest.raises(HabitusError, match="expected as many"):
        neck_twist([body, load_body("default")])
