"""Six numbers of a hand: presets are among them, limits bound them, the Gaussian is the body's own."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.hand_space import HAND_SPACE, hand_gaussian, hand_joints
from habitus.body.hands import HAND_JOINTS, HAND_POSES, SIDES, HandAxes, HandPose, hand_pose
from habitus.body.prior import prior_of, shipped_prior

ROWS = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6)


@cache
def body():
    return hb.load_body("default", joints="smplh")


@pytest.mark.parametrize("name", HAND_POSES)
def test_presets_are_hands_of_the_space_and_within_the_limits(name):
    pose = HAND_POSES[name]
    coordinates = HAND_SPACE.coordinates(pose)
    assert np.abs(coordinates).max() < 2.5
    off = np.abs(HAND_SPACE.pose(coordinates).angles - pose.angles)
    assert off.mean() < 6.0 and off.max() < 20.0
    assert np.all(HAND_SPACE.low <= pose.angles) and np.all(pose.angles <= HAND_SPACE.high)


@settings(max_examples=30, deadline=None)
@given(ROWS)
def test_coordinates_come_back_from_a_pose_within_the_limits(row):
    pose = HAND_SPACE.pose(row)
    if np.all((HAND_SPACE.low < pose.angles) & (pose.angles < HAND_SPACE.high)):
        np.testing.assert_allclose(HAND_SPACE.coordinates(pose), row, atol=1e-9)
        assert HandPose.of(pose.angles) == pose


@pytest.mark.parametrize("side", SIDES)
@settings(max_examples=20, deadline=None)
@given(ROWS)
def test_angles_are_read_off_rotations(side, row):
    axes = HandAxes.of(body(), side)
    angles = np.radians(HAND_SPACE.pose(row).angles)
    found = np.degrees(axes.angles(axes.rotations(angles)) - angles)
    assert np.abs(found).max() < 4.0  # of second order, where a joint bends and turns aside
    hinges = [3 * finger + k for finger in range(5) for k in (1, 2)]
    np.testing.assert_allclose(found[hinges], 0.0, atol=1e-9)


def test_the_gaussian_is_that_of_drawn_hands():
    rng = np.random.default_rng(0)
    drawn = HAND_SPACE.mean + rng.normal(size=(4000, 6)) @ HAND_SPACE.directions
    drawn = np.radians(drawn + rng.normal(size=drawn.shape) * HAND_SPACE.rest)
    mean, covariance = hand_gaussian(body())
    for k, side in enumerate(SIDES):
        turns = HandAxes.of(body(), side).rotations(drawn).reshape(len(drawn), -1)
        part = slice(45 * k, 45 * k + 45)
        np.testing.assert_allclose(turns.mean(axis=0), mean[part], atol=0.03)
        sd = np.sqrt(np.diag(covariance[part, part]))
        assert np.all(np.abs(turns.std(axis=0) - sd) < 0.06)
    np.testing.assert_allclose(covariance[:45, 45:], 0.0)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_hands_of_the_prior_are_mirror_images():
    mean, covariance = hand_gaussian(body())
    mirror = np.tile([1.0, -1.0, -1.0], len(HAND_JOINTS))
    np.testing.assert_allclose(mean[45:], mirror * mean[:45], atol=0.01)
    np.testing.assert_allclose(
        covariance[45:, 45:], np.outer(mirror, mirror) * covariance[:45, :45], atol=0.005
    )


def test_the_prior_of_a_body_has_its_hands_and_the_shipped_rest():
    prior = prior_of(body()).for_joints(body().joint_names)
    shipped = shipped_prior().for_joints(body().joint_names)
    hands = np.isin(prior.joint_names, hand_joints()).repeat(3)
    np.testing.assert_array_equal(prior.mean[~hands], shipped.mean[~hands])
    rest = np.ix_(~hands, ~hands)
    np.testing.assert_array_equal(prior.covariance[rest], shipped.covariance[rest])
    order = [prior.joint_names.index(name) for name in hand_joints()]
    mean, covariance = hand_gaussian(body())
    np.testing.assert_array_equal(prior.mean.reshape(-1, 3)[order].ravel(), mean)
    columns = np.add.outer(3 * np.array(order), np.arange(3)).ravel()
    np.testing.assert_array_equal(prior.covariance[np.ix_(columns, columns)], covariance)
    assert prior_of(hb.load_body("default")).joint_names == shipped_prior().joint_names


def posed(pose):
    turns = np.zeros((1, body().num_joints, 3))
    for name, turn in hand_pose(body(), pose).items():
        turns[0, body().joint_names.index(name)] = turn
    return turns


def test_limits_cost_nothing_within_and_grow_beyond():
    term = hb.terms.HandLimits(body())
    for name in HAND_POSES:
        np.testing.assert_array_equal(term(posed(name)), 0.0)
    beyond = term(posed(HandPose(index=(0.0, -40.0, 0.0), ring=(0.0, 0.0, 93.0))))
    columns = np.flatnonzero(beyond[0])
    assert list(columns) == [1, 8, 21, 28]
    np.testing.assert_allclose(beyond[0, columns], [-10.0, 1.0, -10.0, 1.0], atol=1e-6)


def test_limits_have_the_slopes_of_their_cost_in_torch():
    torch = pytest.importorskip("torch")
    pose = posed(HandPose(index=(0.0, -40.0, 0.0), thumb=(40.0, 0.0, 0.0)))
    term = hb.terms.HandLimits(body())
    tensor = torch.tensor(pose, requires_grad=True)
    cost = (term(tensor) ** 2).sum()
    (slope,) = torch.autograd.grad(cost, tensor)
    way = np.random.default_rng(1).normal(size=pose.shape)
    ahead, behind = ((term(pose + step * way) ** 2).sum() for step in (1e-6, -1e-6))
    np.testing.assert_allclose((slope.numpy() * way).sum(), (ahead - behind) / 2e-6, rtol=1e-5)


def test_limits_turn_an_overextended_finger_back():
    start = posed(HandPose(index=(0.0, -40.0, 0.0)))
    terms = {
        "limits": hb.terms.HandLimits(body()),
        "held": hb.Term(lambda pose: (pose - start, {"pose": np.eye(start.size)}), 1e-6),
    }
    found = hb.minimize(terms, {"pose": start})
    joint = body().joint_names.index("left_index2")
    turned = Rotation.from_rotvec(start[0, joint]).inv() * Rotation.from_rotvec(
        found.values["pose"][0, joint]
    )
    assert abs(np.degrees(turned.magnitude()) - 30.0) < 0.1
