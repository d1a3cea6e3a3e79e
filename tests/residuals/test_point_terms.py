"""Points on a body against their places: the compiled way is the dense one, and that is what small
steps show.
"""

from dataclasses import replace

import numpy as np
import pytest
from hinged_body import with_hinges
from synthetic import synthetic_body

from habitus.io.models.bodies import load_body
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import MarkerAttachment, marker_jacobian
from habitus.residuals.points import (
    JointObservations,
    PointObservations,
    PointSolver,
    point_residuals,
    points_on_surface,
    points_term,
    reference_equations,
)
from habitus.solve.minimize import minimize
from habitus.solve.terms import Term


def some_points(body, slide: float, seed: int = 0, count: int = 60):
    rng = np.random.default_rng(seed)
    face = rng.integers(0, body.num_faces, count)
    target = rng.normal(size=(count, 3))
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return PointObservations.to_planes(
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
    fast = PointSolver.of(body).at(*state, matches)
    slow = reference_equations(body, *state, matches)
    for ours, theirs in zip(fast, slow, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_the_gradient_is_what_small_steps_show():
    body = synthetic_body("smpl", 120)
    (betas, pose, trans), matches = some_state(body), some_points(body, 0.3)
    solver = PointSolver.of(body)
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
    matches = PointObservations.to_planes(face, share, target, normal, weight, 0.2)
    np.testing.assert_allclose(PointSolver.of(body).at(betas, pose, trans, matches).cost, expected)


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
def test_observations_together_are_the_sum_of_each(skinning):
    body = replace(synthetic_body("smpl", 120), skinning=skinning)
    (betas, first, here), (_, second, there) = some_state(body, 1), some_state(body, 2)
    matches = [some_points(body, 0.0, seed) for seed in (3, 4)]
    solver = PointSolver.of(body)
    cost, gradient, matrix = solver.together(
        betas, np.stack([first, second]), np.stack([here, there]), matches
    )
    each = [
        reference_equations(body, betas, *state)
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


def some_joints(body, seed: int = 7, count: int = 9):
    rng = np.random.default_rng(seed)
    return JointObservations(
        rng.integers(0, body.num_joints, count),
        0.2 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 2, 3)),
    )


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
@pytest.mark.parametrize("some", [some_joints, lambda body: some_points(body, 0.2)])
def test_the_cost_alone_is_that_of_the_equations(skinning, some):
    body = replace(synthetic_body("smpl", 120), skinning=skinning)
    state = some_state(body)
    solver = PointSolver.of(body)
    np.testing.assert_allclose(solver.cost(*state, some(body)), solver.at(*state, some(body)).cost)


def test_a_joint_is_where_the_body_has_it():
    body = synthetic_body("smpl", 120)
    betas, pose, trans = some_state(body)
    observed = replace(
        some_joints(body), offset=np.zeros((9, 3)), directions=np.tile(np.eye(3), (9, 1, 1))
    )
    joints = body(betas, pose, trans).joints[observed.joint]
    off = point_residuals(body, betas, pose, trans, observed)
    np.testing.assert_allclose(off, joints - observed.target, atol=1e-12)


def test_an_offset_turns_with_its_joint():
    """The skin of a body without blend shapes or mixed weights is rigid on its joints too."""
    body = synthetic_body("smpl", 120)
    joint = body.skinning_weights.argmax(1)
    rigid = {"skinning_index": joint[:, None], "skinning_value": np.ones((len(joint), 1))}
    body = replace(body, posedirs=None, **rigid)
    _, pose, trans = some_state(body)
    betas = np.zeros(body.num_betas)
    offset = body.v_template - body.rest_joints(betas)[joint]
    count = body.num_vertices
    directions = np.tile(np.eye(3), (count, 1, 1))
    observed = JointObservations(joint, offset, np.zeros((count, 3)), directions)
    np.testing.assert_allclose(
        point_residuals(body, betas, pose, trans, observed),
        body(betas, pose, trans).vertices,
        atol=1e-9,
    )


@pytest.mark.parametrize("single", [True, False])
def test_the_term_is_the_slope_of_its_cost(single):
    body = synthetic_body("smpl", 120)
    frames = [[some_points(body, 0.1), some_joints(body)]]
    states = [some_state(body, 1)]
    if not single:
        frames += [None, some_points(body, 0.0, 5)]
        states += [some_state(body, 2), some_state(body, 3)]
    term = points_term(body, frames, 2.0)
    values = {
        "betas": states[0][0],
        "pose": np.stack([each[1] for each in states]),
        "trans": np.stack([each[2] for each in states]),
    }
    if single:
        values = {**values, "pose": values["pose"][0], "trans": values["trans"][0]}
    rng = np.random.default_rng(0)
    slopes, blocks = term(values).quadratic.derivatives()
    for name in values:
        along = rng.normal(size=values[name].shape)
        moved = [{**values, name: values[name] + h * along} for h in (1e-6, -1e-6)]
        change = (term(moved[0]).cost - term(moved[1]).cost) / 2e-6
        np.testing.assert_allclose(np.ravel(slopes[name]) @ along.ravel(), change, rtol=1e-6)
    if not single:
        assert not slopes["pose"][1].any() and not blocks["pose", "betas"][1].any()


def test_a_term_of_points_is_solved_as_an_arrow_and_dense_alike():
    body = synthetic_body("smpl", 120)
    rng = np.random.default_rng(1)
    betas, frames = 0.5 * rng.normal(size=body.num_betas), []
    begin = {
        "betas": np.zeros(body.num_betas),
        "pose": np.zeros((2, body.num_joints, 3)),
        "trans": np.zeros((2, 3)),
    }
    for k in range(2):
        points = some_points(body, 0.3, k, 200)
        pose = 0.2 * rng.normal(size=(body.num_joints, 3))
        vertices = body(betas, pose, np.full(3, 0.1)).vertices
        target = points_on_surface(vertices, body.faces, points.face, points.barycentric)
        frames.append(replace(points, target=target))
    terms = {
        "points": points_term(body, frames),
        "pose": Term(lambda pose: (pose.ravel(), {"pose": np.eye(pose.size)}), 1e-6),
    }
    ours, theirs = (
        minimize(terms, begin, blocks=blocks, stretch=False, max_iterations=30)
        for blocks in (("pose", "trans"), ())
    )
    assert ours.costs["points"] < 1e-3
    np.testing.assert_allclose(ours.cost, theirs.cost, rtol=1e-6)
    np.testing.assert_allclose(ours.values["betas"], betas, atol=0.02)


def test_markers_are_a_special_case():
    """Markers at vertices, by the marker solve's kernels and Jacobian, are points at corners."""
    body = synthetic_body("smpl", 120)
    betas, pose, trans = some_state(body)
    face = np.random.default_rng(2).integers(0, body.num_faces, 20)
    on_corner = MarkerAttachment(body.faces[face], np.zeros((20, 3)))
    target = np.random.default_rng(3).normal(size=(20, 3))
    corner = np.tile([1.0, 0.0, 0.0], (20, 1))
    weight = np.linspace(0.0, 2.0, 20)
    observed = PointObservations.to_points(face, corner, target, weight)
    solver = PointSolver.of(body)

    predicted = predict(marked_body(body, betas, on_corner), pose[None], trans[None])[0]
    cost = 0.5 * float((weight * ((predicted - target) ** 2).sum(1)).sum())
    np.testing.assert_allclose(solver.cost(betas, pose, trans, observed), cost, rtol=1e-9)

    moved = marker_jacobian(body, on_corner, betas, pose[None], trans[None])
    by_trans = np.tile(np.eye(3), (20, 1, 1))
    rows = np.concatenate([moved.by_betas[0], by_trans, moved.by_pose[0]], axis=2)
    rows = (np.sqrt(weight)[:, None, None] * rows).reshape(60, -1)
    residual = (np.sqrt(weight)[:, None] * (predicted - target)).ravel()
    ours = solver.at(betas, pose, trans, observed)
    np.testing.assert_allclose(ours.gradient, rows.T @ residual, atol=1e-9)
    np.testing.assert_allclose(ours.matrix, rows.T @ rows, atol=1e-9)


def test_a_state_that_changes_in_place_is_a_new_one():
    body = synthetic_body("smpl", 120)
    (betas, pose, trans), points = some_state(body), some_points(body, 0.1)
    solver = PointSolver.of(body)
    first = solver.cost(betas, pose, trans, points)
    betas += 0.5
    again = solver.cost(betas, pose, trans, points)
    assert first != again
    assert again == PointSolver.of(body).cost(betas, pose, trans, points)
    assert solver.at(betas - 0.5, pose, trans, points).cost == pytest.approx(first)


@pytest.mark.parametrize("degrees", [40.0, 100.0, 140.0])
def test_hinges_are_compiled_too(degrees):
    """Cost, gradient and matrix in a fold, by betas as well, at points that hinges move."""
    body = with_hinges(load_body("female"))
    knee = body.joint_names.index("left_knee")
    near = np.flatnonzero(body.hinges.directions[body.faces].any((1, 2, 3, 4)))
    points = some_points(body, 0.1)
    points = replace(points, face=near[np.linspace(0, len(near) - 1, len(points.face), dtype=int)])
    betas, pose, trans = some_state(body)
    pose = 0.2 * pose
    pose[knee] = [np.radians(degrees), 0.1, 0.0]
    solver = PointSolver.of(body)
    assert solver.rig is not None
    fast = solver.at(betas, pose, trans, points)
    slow = reference_equations(body, betas, pose, trans, points)
    for ours, theirs in zip(fast, slow, strict=True):
        scale = np.abs(theirs).max()
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * scale)
    assert solver.cost(betas, pose, trans, points) == pytest.approx(slow.cost, rel=1e-9)
