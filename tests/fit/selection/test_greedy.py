"""Markers chosen one by one: all candidates of a step are told exactly, and as fits tell them."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_fit import tube_body

from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.selection.full import best_states, fit_surface, full_error, surface_terms
from habitus.fit.selection.greedy import ADD, REMOVE, additions, removals, set_error, step_errors
from habitus.fit.selection.held_out import held_out_people, smooth_field
from habitus.fit.selection.problem import (
    GOALS,
    REGIONS,
    Candidates,
    linearised,
    region_joints,
    region_vertices,
)
from habitus.parallel.workers import Threads


@pytest.fixture(scope="module")
def scene() -> SimpleNamespace:
    body = tube_body(betas=4)
    joints = len(body.joint_names) - 1
    prior = PosePrior(body.joint_names[1:], np.zeros(3 * joints), 0.02 * np.eye(3 * joints))
    drawn = held_out_people([tube_body(betas=4)], prior, 4, 0)
    people = best_states(body, prior, drawn, np.arange(0, body.num_vertices, 4))
    vertices = np.arange(0, body.num_vertices, 80)
    count = len(vertices)
    groups = ((0, 1), *((k,) for k in range(2, count)))
    candidates = Candidates(tuple(f"M{k}" for k in range(count)), vertices, groups)
    problem = linearised(body, prior, people, candidates)
    return SimpleNamespace(
        body=body, prior=prior, people=people, candidates=candidates, problem=problem
    )


def test_a_step_tells_what_each_set_tells_by_itself(scene):
    groups = (0, 3, 4, 7)
    others = (1, 2, 5, 6)
    came = step_errors(scene.problem, groups, others, ADD)
    went = step_errors(scene.problem, groups, groups, REMOVE, Threads(2))
    np.testing.assert_allclose(
        np.sqrt(came), [set_error(scene.problem, (*groups, k)) for k in others], rtol=1e-9
    )
    less = [set_error(scene.problem, tuple(j for j in groups if j != k)) for k in groups]
    np.testing.assert_allclose(np.sqrt(went), less, rtol=1e-9)


def test_paths_choose_the_best_and_end_where_they_are_told(scene):
    every = range(len(scene.candidates.groups))
    down = list(removals(scene.problem, every, 2))
    assert [len(step.groups) for step in down] == list(range(len(every), 1, -1)) and down[
        0
    ].group is None
    for before, step in pairwise(down):
        assert set(before.groups) - set(step.groups) == {step.group}
        others = [
            set_error(scene.problem, [k for k in before.groups if k != gone])
            for gone in before.groups
        ]
        assert step.error == pytest.approx(min(others), rel=1e-9)
    up = list(additions(scene.problem, down[-1].groups, len(every)))
    assert len(up[-1].groups) == len(every) and up[-1].error == pytest.approx(down[0].error)
    assert down[-1].error > 2 * down[0].error  # with two markers a body is anyone's
    assert scene.candidates.count((0, 1)) == 3


def test_without_what_the_body_cannot_explain_more_markers_are_never_worse(scene):
    problem = replace(
        scene.problem,
        unexplained=0 * scene.problem.unexplained,
        constant=0 * scene.problem.constant,
    )
    errors = [step.error for step in removals(problem, range(len(scene.candidates.groups)), 1)]
    assert (np.diff(errors) > 0).all()


def test_fits_agree_with_the_first_order(scene):
    """On average over draws of noise, where the state is well known."""
    rng = np.random.default_rng(1)
    body = scene.body
    vertices = np.arange(0, scene.body.num_vertices, 9)
    candidates = Candidates(
        tuple(map(str, vertices)), vertices, tuple((k,) for k in range(len(vertices)))
    )
    problem = linearised(body, scene.prior, scene.people, candidates, noise=0.004)
    judged = region_vertices(body, region_joints(body, "all"))
    offsets = rng.normal(scale=0.004, size=(len(scene.people), body.num_vertices, 3))
    full = full_error(body, scene.prior, scene.people, vertices, judged, offsets, 0.004)
    assert full == pytest.approx(set_error(problem, range(len(vertices))), rel=0.15)


def test_a_surface_of_the_body_is_found_again(scene):
    one = scene.people[0]
    surface = scene.body(one.betas, one.pose, one.trans).vertices
    every = np.arange(scene.body.num_vertices)
    start = replace(one, pose=one.pose + 0.05, surface=surface)
    found, status = fit_surface(scene.body, scene.prior, start, every, surface, 1e-4)
    assert status == "converged"
    assert (
        np.linalg.norm(
            scene.body(found.betas, found.pose, found.trans).vertices - surface, axis=1
        ).max()
        < 2e-4
    )


def test_derivatives_of_the_surface_terms_are_those_of_their_residuals(scene):
    one = scene.people[0]
    chosen = np.arange(0, scene.body.num_vertices, 40)
    terms = surface_terms(scene.body, scene.prior, chosen, one.surface[chosen], 0.004)
    values = {"betas": one.betas, "pose": one.pose, "trans": one.trans}
    for term in terms.values():
        found = term(values)
        jacobians = found.jacobians() if callable(found.jacobians) else found.jacobians
        for name, value in values.items():
            step = 1e-6
            moved = value.copy()
            moved.flat[-1] += step
            slope = (term(values | {name: moved}).value - found.value) / step
            np.testing.assert_allclose(jacobians[name][:, -1], slope, atol=1e-4)


@pytest.mark.parametrize("goal", GOALS)
@pytest.mark.parametrize("region", ["all", "legs"])
def test_every_goal_of_every_region(scene, goal, region):
    problem = linearised(scene.body, scene.prior, scene.people[:1], scene.candidates, goal, region)
    assert set_error(problem, range(8)) < set_error(problem, range(2))
    assert np.linalg.eigvalsh(problem.quadratic[0]).min() > -1e-9


def test_what_there_is_not(scene):
    for given in ({"goal": "beauty"}, {"region": "tail"}):
        with pytest.raises(HabitusError, match="expected one of"):
            linearised(scene.body, scene.prior, scene.people, scene.candidates, **given)
    assert len(region_joints(scene.body, "all")) == 24
    assert all(len(region_joints(scene.body, name)) for name in REGIONS)


def test_what_no_body_explains_is_smooth_and_of_variance_one():
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(400, 3))
    fields = np.stack([smooth_field(points, rng) for _ in range(60)])
    assert fields.std() == pytest.approx(1.0, abs=0.1)
    near = smooth_field(np.array([[0, 0, 0], [0.005, 0, 0]]), rng)
    assert np.abs(near[0] - near[1]).max() < 0.5
