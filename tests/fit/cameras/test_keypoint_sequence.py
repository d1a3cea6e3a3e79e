"""The compiled steps of the pose stage against derivatives of the cost and the plain form of a
step; keypoints on bones against the body itself.
"""

from functools import cache

import numpy as np
import pytest

from habitus.body.keypoints import CONVENTIONS
from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.fit.cameras.sequence import (
    KeypointSequence,
    acceleration_links,
    keypoint_data,
    solve_poses,
)
from habitus.fit.cameras.settings import CAMERAS
from habitus.io.models.bodies import load_body
from habitus.observe.keypoints import KeypointRig
from habitus.solve.sequence import DenseVisits, solve_sequence
from habitus_lab.population.camera_scenes import ring

NAMES = CONVENTIONS["body25b"]
FRAMES = 24


@cache
def _body() -> BodyModel:
    return load_body("neutral")


def _motion(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A slow motion about the prior's mean."""
    prior = prior_of(_body()).for_joints(_body().joint_names)
    ways = rng.normal(size=(2, len(prior.mean))) @ np.linalg.cholesky(prior.covariance).T
    phase = np.linspace(0.0, 2.0, FRAMES)[:, None]
    own = prior.mean + 0.6 * (np.sin(phase) * ways[0] + np.cos(phase) * ways[1])
    turn = np.concatenate([np.zeros((FRAMES, 1)), 0.4 * phase, np.zeros((FRAMES, 1))], 1)
    pose = np.concatenate([turn, own], 1).reshape(FRAMES, -1, 3)
    return pose, np.concatenate([0.1 * phase, 0.0 * phase, 0.0 * phase], 1)


@cache
def _problem(noise: float = 0.0):
    rng = np.random.default_rng(3)
    body = _body()
    prior = prior_of(body).for_joints(body.joint_names)
    person = KeypointRig.of(body, NAMES).shaped(
        rng.normal(size=body.num_betas), 0.01 * rng.normal(size=(len(NAMES), 3))
    )
    pose, trans = _motion(rng)
    points = person.points(pose, trans)
    rig = ring(3, points.mean((0, 1)), 4.0)
    pixels = np.moveaxis(rig.project(points), 0, 1) + noise * rng.normal(
        size=(FRAMES, 3, len(NAMES), 2)
    )
    pixels[rng.random(pixels.shape[:3]) < 0.1] = np.nan
    weights = np.full(pixels.shape[:3], 1.0 / 25.0)
    known = np.where(rng.random((FRAMES, len(NAMES), 1)) < 0.2, points + 0.01, np.nan)
    data = keypoint_data(
        person, rig, pixels, weights, prior.mean, prior.precision, 5.0, known,
        np.full(known.shape[:2], 1e3),
    )  # fmt: skip
    return data, pose, trans, points, person


def test_the_gradient_is_that_of_the_cost():
    data, pose, trans, _, _ = _problem()
    sequence = KeypointSequence(data, np.zeros(75))
    rng = np.random.default_rng(0)
    states = np.concatenate([trans, pose.reshape(FRAMES, -1)], 1)[:2]
    states = states + 0.05 * rng.normal(size=states.shape)
    cost, gradient, matrix = sequence.linearize(np.array([0, 1]), states)
    np.testing.assert_allclose(cost, sequence.cost(np.array([0, 1]), states))
    step = 1e-6
    for t in (0, 1):
        moved = states[t] + step * np.concatenate([np.eye(75), -np.eye(75)])
        ends = sequence.cost(np.full(150, t), moved).reshape(2, 75)
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(gradient[t], numeric, atol=1e-5 * np.abs(numeric).max())
        np.testing.assert_allclose(matrix[t], matrix[t].T)
        assert np.linalg.eigvalsh(matrix[t]).min() > 0.0


def test_the_matrix_is_the_jacobians_product_where_errors_are_small():
    """Gauss-Newton: with exact data the cost's curvature is the matrix."""
    data, pose, trans, _, _ = _problem()
    data = data._replace(
        precision=np.zeros_like(data.precision), point_weights=data.point_weights * 0
    )
    sequence = KeypointSequence(data, np.zeros(75))
    state = np.concatenate([trans, pose.reshape(FRAMES, -1)], 1)[4]
    _, _, matrix = sequence.linearize(np.array([4]), state[None])
    rng = np.random.default_rng(1)
    for _ in range(5):
        way = rng.normal(size=75)
        way /= np.linalg.norm(way)
        h = 1e-4
        ends = sequence.cost(np.full(3, 4), state + h * np.array([[1.0], [0.0], [-1.0]]) * way)
        curvature = (ends[0] - 2.0 * ends[1] + ends[2]) / h**2
        np.testing.assert_allclose(way @ matrix[0] @ way, curvature, rtol=1e-3)


class _Plain(DenseVisits, KeypointSequence):
    """The same problem with the plain form of a step."""

    cost = KeypointSequence.cost
    linearize = KeypointSequence.linearize


@pytest.mark.parametrize("coupled", [True, False])
def test_compiled_steps_are_the_plain_ones(coupled):
    data, pose, trans, _, _ = _problem(noise=4.0)
    links = acceleration_links(24, 60.0, CAMERAS) if coupled else np.zeros(75)
    rng = np.random.default_rng(2)
    start = np.concatenate([trans, pose.reshape(FRAMES, -1)], 1)
    start = start + 0.05 * rng.normal(size=start.shape)
    ends = []
    for kind in (KeypointSequence, _Plain):
        problem = kind(data, links)
        problem.threads = 1
        ends.append(solve_sequence(problem, start, slice(3, None), CAMERAS.options))
    np.testing.assert_allclose(ends[0].states, ends[1].states, atol=1e-6)
    np.testing.assert_allclose(ends[0].history[-1], ends[1].history[-1], rtol=1e-9)


def test_exact_detections_give_the_motion_back():
    data, pose, trans, points, person = _problem()
    rng = np.random.default_rng(4)
    begin = pose + 0.1 * rng.normal(size=pose.shape)
    weak = data._replace(precision=1e-4 * data.precision, point_weights=data.point_weights * 0)
    found, place, solution = solve_poses(weak, begin, trans + 0.05, 60.0, CAMERAS)
    assert solution.status == "converged"
    apart = np.linalg.norm(person.points(found, place) - points, axis=-1)
    assert np.median(apart) < 0.002


@pytest.mark.parametrize("convention", list(CONVENTIONS))
def test_keypoints_on_bones_are_those_of_the_body(convention):
    """At rest exactly; in a pose but for what skin does beside its bone."""
    body = _body()
    rng = np.random.default_rng(5)
    betas = rng.normal(size=body.num_betas)
    rig = KeypointRig.of(body, CONVENTIONS[convention])
    none = np.zeros((len(rig.names), 3))
    for amount, most in ((0.0, 1e-9), (0.3, 0.03)):
        pose = amount * rng.normal(size=(1, 24, 3))
        own = rig.shaped(betas, none).points(pose, np.zeros((1, 3)))[0]
        surface = body(betas, pose[0])
        assert np.abs(own - np.asarray(body.keypoints(convention, surface))).max() < most


def test_derivatives_of_keypoints():
    body = _body()
    rng = np.random.default_rng(6)
    rig = KeypointRig.of(body, NAMES)
    betas, offsets = rng.normal(size=body.num_betas), 0.02 * rng.normal(size=(len(NAMES), 3))
    pose, trans = 0.5 * rng.normal(size=(2, 24, 3)), rng.normal(size=(2, 3))
    found = rig.derivatives(betas, offsets, pose, trans)
    here = rig.shaped(betas, offsets).points(pose, trans)
    np.testing.assert_allclose(found.points, here, atol=1e-12)
    h = 1e-6
    for joint, axis in ((0, 1), (5, 2), (18, 0)):
        moved = pose.copy()
        moved[:, joint, axis] += h
        slope = (rig.shaped(betas, offsets).points(moved, trans) - here) / h
        np.testing.assert_allclose(found.by_pose[..., 3 * joint + axis], slope, atol=1e-5)
    for k in (0, 4):
        slope = (
            rig.shaped(betas + h * np.eye(len(betas))[k], offsets).points(pose, trans) - here
        ) / h
        np.testing.assert_allclose(found.by_betas[..., k], slope, atol=1e-5)
    shift = np.array([0.3, -0.2, 0.5])
    moved = rig.shaped(betas, offsets + shift).points(pose, trans) - here
    np.testing.assert_allclose(found.by_offsets @ shift, moved, atol=1e-12)
