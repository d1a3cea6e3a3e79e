"""Points on a body against their places: the compiled way is the dense one, and that is what small
steps show.
"""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import synthetic_body

from habitus.residuals.surface_points import (
    PointMatches,
    SurfacePointSolver,
    points_on_surface,
    slow_equations,
)


def some_points(body, slide: float, seed: int = 0, count: int = 60):
    rng = np.random.default_rng(seed)
    face = rng.integers(0, body.num_faces, count)
    target = rng.normal(size=(count, 3))
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return PointMatches.to_planes(
        face, rng.dirichlet((1, 1, 1), count), target, normal, rng.uniform(0, 2, count), slide
    )


def some_state(body, seed: int = 1):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=body.num_betas),
        0.5 * rng.normal(size=(body.num_joints, 3)),
        rng.normal(size=3),
    )


@pytest.mark.parametrize("slide", [0.0, 0.1])
@pytest.mark.parametrize("posedirs", [True, False])
def test_the_compiled_way_is_the_dense_one(slide, posedirs):
    body = synthetic_body("smpl", 120)
    body = body if posedirs else replace(body, posedirs=None)
    state = some_state(body)
    matches = some_points(body, slide)
    fast = SurfacePointSolver.of(body).at(*state, matches)
    slow = slow_equations(body, *state, matches)
    for ours, theirs in zip(fast, slow, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_the_gradient_is_what_small_steps_show():
    body = synthetic_body("smpl", 120)
    (betas, pose, trans), matches = some_state(body), some_points(body, 0.3)
    solver = SurfacePointSolver.of(body)
    rng = np.random.default_rng(3)
    step = 1e-6
    gradient = solver.at(betas, pose, trans, matches).gradient
    for _ in range(3):
        along = [rng.normal(size=part.shape) for part in (betas, trans, pose)]
        ahead, behind = (
            solver.at(betas + h * along[0], pose + h * along[2], trans + h * along[1], matches).cost
            for h in (step, -step)
        )
        expected = gradient @ np.concatenate([part.ravel() for part in along])
        np.testing.assert_allclose((ahead - behind) / (2 * step), expected, rtol=1e-6)


def test_the_cost_is_of_planes_and_of_points():
    body = synthetic_body("smpl", 120)
    (betas, pose, trans), rng = some_state(body), np.random.default_rng(5)
    face = rng.integers(0, body.num_faces, 20)
    share = rng.dirichlet((1, 1, 1), 20)
    target = rng.normal(size=(20, 3))
    weight = rng.uniform(0, 2, 20)
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    apart = points_on_surface(body(betas, pose, trans).vertices, body.faces, face, share) - target
    expected = 0.5 * (weight * ((normal * apart).sum(1) ** 2 + 0.2 * (apart**2).sum(1))).sum()
    matches = PointMatches.to_planes(face, share, target, normal, weight, 0.2)
    np.testing.assert_allclose(
        SurfacePointSolver.of(body).at(betas, pose, trans, matches).cost, expected
    )


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
def test_observations_together_are_the_sum_of_each(skinning):
    body = replace(synthetic_body("smpl", 120), skinning=skinning)
    (betas, first, here), (_, second, there) = some_state(body, 1), some_state(body, 2)
    matches = [some_points(body, 0.0, seed) for seed in (3, 4)]
    solver = SurfacePointSolver.of(body)
    cost, gradient, matrix = solver.together(
        betas, np.stack([first, second]), np.stack([here, there]), matches
    )
    each = [
        slow_equations(body, betas, *state)
        for state in zip((first, second), (here, there), matches, strict=True)
    ]
    head = body.num_betas
    size = len(each[0].gradient)
    expected = np.zeros((2 * size - head,) * 2)
    for k, one in enumerate(each):
        rows = np.concatenate([np.arange(head), head + k * (size - head) + np.arange(size - head)])
        expected[np.ix_(rows, rows)] += one.matrix
        np.testing.assert_allclose(gradient[rows[head:]], one.gradient[head:], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(matrix.dense(), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cost, each[0].cost + each[1].cost)
    np.testing.assert_allclose(
        gradient[:head], each[0].gradient[:head] + each[1].gradient[:head], atol=1e-9
    )
