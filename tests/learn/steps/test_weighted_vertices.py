"""Vertices that count less, and holes: every term of training hears the weights, and nothing in a
hole is heard.
"""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import disturbed, people, planted, poses, small_body, small_rig

from habitus.body.skinning import SKINNING
from habitus.learn.energy import costs, energy_terms, measure_energy, unknowns
from habitus.learn.estimate import PosedTarget
from habitus.learn.options import POSE_SHAPES, EnergyWeights
from habitus.learn.posing.surface import pose_normalized, surface
from habitus.learn.start.first_estimate import edge_pose
from habitus.learn.steps.alternation import STEPS, over_relax
from habitus.learn.steps.poses import (
    VertexDistance,
    edge_distance,
    fit_pose,
    pose_terms,
    surface_jacobians,
)
from habitus.learn.steps.subjects import solve_subject
from habitus.learn.steps.weights import gather_quadratics, vertex_costs
from habitus.parallel.workers import Threads

SMALL = small_body(pairs=6, middle=1)
ALONE = Threads(1)
V = len(SMALL.vertices)
EDGES = edge_distance(SMALL.faces, V)
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))


def with_holes(registrations, seed=0, fill=np.nan):
    """A quarter of each registration's vertices unseen, and one everywhere; the others count by
    chance.
    """
    rng = np.random.default_rng([seed, 77])
    shape = registrations.vertices.shape[:2]
    holes = rng.random(shape) < 0.25
    weights = rng.uniform(0.2, 1.0, shape)
    holes[:, 3] = True
    return replace(
        registrations,
        vertices=np.where(holes[..., None], fill, registrations.vertices),
        weights=np.where(holes, 0.0, weights),
    )


def some(fill=np.nan, **changes):
    options = {
        "rank": 5,
        "l1": 0.01,
        "weights": EnergyWeights(joints=5.0, pose_shapes=0.5),
    } | changes
    problem, truth = planted(small=SMALL, each=5, noise=0.003, **options)
    return replace(problem, registrations=with_holes(problem.registrations, fill=fill)), disturbed(
        truth
    )


@skinnings
@pytest.mark.parametrize("kind", POSE_SHAPES)
def test_no_step_raises_the_energy_and_none_hears_what_is_in_a_hole(skinning, kind):
    (problem, estimate), (other, _) = (
        some(fill, skinning=skinning, pose_shapes=kind) for fill in (np.nan, 7.0)
    )
    first = before = measure_energy(problem, estimate, ALONE).total
    start = estimate
    for name, step in STEPS.items():
        told = step(other, estimate, ALONE)
        estimate = step(problem, estimate, ALONE)
        after = measure_energy(problem, estimate, ALONE)
        assert after.total <= before * (1 + 1e-9), name
        for key, value in unknowns(estimate).items():
            assert np.isfinite(value).all() and np.allclose(
                value, unknowns(told)[key], atol=1e-12
            ), (name, key)
        before = after.total
    estimate, energy = over_relax(problem, start, estimate, after, ALONE)
    assert energy.total <= before and before < 0.3 * first
    assert energy.total == pytest.approx(
        sum(costs(energy_terms(problem, estimate), unknowns(estimate)).values())
    )


@skinnings
def test_a_registration_counts_as_much_as_two_of_which_each_counts_in_part(skinning):
    rig, (person,) = small_rig(SMALL, 1, skinning), people(SMALL, 1, 1)
    rng = np.random.default_rng(4)
    places = rng.normal(size=(5, 3))
    turns = poses(5, 1)
    seen = [
        surface(rig, person, p) + t + 0.01 * rng.normal(size=(V, 3))
        for p, t in zip(turns, places, strict=True)
    ]
    whole = [PosedTarget(*each) for each in zip(seen, turns, places, strict=True)]
    parts = rng.uniform(0, 1, (5, V))
    split = [replace(t, weight=w) for t, p in zip(whole, parts, strict=True) for w in (p, 1 - p)]
    problem, _ = planted(small=SMALL)
    for held in (False, True):
        one, two = (
            solve_subject(rig, person.descriptor, t, problem.anatomy, EnergyWeights(), held=held)
            for t in (whole, split)
        )
        assert all(np.allclose(a, b, atol=1e-9) for a, b in zip(one, two, strict=True))
    one, two = (
        gather_quadratics(rig, problem.candidates, [(person, t) for t in each])
        for each in (whole, split)
    )
    assert np.allclose(one.matrix, two.matrix) and np.allclose(one.vector, two.vector)
    one, two = (vertex_costs([rig], [(person, t) for t in each]) for each in (whole, split))
    assert np.allclose(one, two)


@pytest.mark.parametrize("distance", [VertexDistance(), EDGES], ids=["vertices", "edges"])
def test_poses_are_fitted_to_what_is_seen(distance):
    """The normal equations are the term's, and noise where weights are zero changes nothing."""
    rng = np.random.default_rng(1)
    rig, (person,) = small_rig(SMALL, 1), people(SMALL, 1, 1)
    pose = poses(1, 4, 0.6)[0]
    place = np.array([0.3, -0.2, 0.1])
    weight = np.where(rng.random(V) < 0.2, 0.0, rng.uniform(0.1, 1, V))
    target = surface(rig, person, pose) + place
    spoilt = np.where(weight[:, None] > 0, target, rng.normal(size=(V, 3)))
    by = (
        VertexDistance(weight)
        if isinstance(distance, VertexDistance)
        else distance.weighted(weight)
    )
    outcome = pose_terms(rig, person, target, by)[by.name]({"pose": pose + 0.05})
    jacobian = outcome.jacobians()["pose"]
    residual = np.asarray(outcome.value)
    moved = surface(rig, person, pose + 0.05) - target
    assert by.energy(moved) == pytest.approx(residual @ residual, rel=1e-6)
    shift = by.energy(moved + rng.normal(size=3))
    assert shift == pytest.approx(by.energy(moved), rel=1e-6)
    rows = surface_jacobians(rig, person, pose + 0.05)[1]
    gradient, matrix = by.normal_equations(moved, rows)
    assert np.allclose(gradient, jacobian.T @ residual, atol=1e-6)
    assert np.allclose(matrix, jacobian.T @ jacobian, rtol=1e-6, atol=1e-6)
    fit = fit_pose(rig, person, spoilt, pose + 0.05, distance=by, max_iterations=30)
    assert (
        fit.energy < 1e-8
        and np.abs(fit.trans - place).max() < 1e-5
        and np.abs(fit.pose - pose).max() < 1e-4
    )
    if by.name == "edges":
        assert edge_pose(rig, person, SMALL.part, spoilt, weight, EDGES).energy < 1e-6


def test_a_rest_surface_is_what_is_seen_and_goes_on_smoothly_where_nothing_is():
    rig, (person, general) = small_rig(SMALL, 1), people(SMALL, 2, 1)
    pose = poses(1, 3, 0.7)[0]
    target = surface(rig, replace(person, descriptor=general.descriptor), pose)
    seen = np.ones(V, bool)
    seen[[2, 9, 20]] = False
    spoilt = np.where(seen[:, None], target, 3.0)
    found = pose_normalized(rig, SMALL.regressor, general, pose, spoilt, seen, EDGES.laplacian)
    posed = surface(rig, replace(general, template=found, joints=SMALL.regressor @ found), pose)
    off = (posed - target)[seen]
    assert np.abs(off - off.mean(0)).max() < 1e-5  # but for where it stands
    away = found - general.template
    neighbours = -EDGES.laplacian.toarray() * (1 - np.eye(V))
    mean = neighbours @ away / neighbours.sum(1, keepdims=True)
    assert np.abs((away - mean)[[2, 9, 20]]).max() < 1e-6
