"""Skinning weights: of all sparse convex weights the best, and with dual quaternions never worse (S
4.1).
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import minimize
from small_rigs import PARENTS, disturbed, people, planted, poses, small_body, small_rig

from habitus.body.skinning import SKINNING
from habitus.learn.estimate import PosedTarget, posed_targets
from habitus.learn.options import EnergyWeights
from habitus.learn.posing.rig import influences, kinship
from habitus.learn.posing.surface import surface
from habitus.learn.steps.alternation import weight_step
from habitus.learn.steps.weights import (
    Quadratics,
    candidate_joints,
    gather_quadratics,
    midpoint_rig,
    minimize_quadratics,
    select_rigs,
    vertex_costs,
)
from habitus.parallel.workers import Threads

SMALL = small_body()
V, J = SMALL.weights.shape
ALL = np.tile(np.arange(J), (V, 1))
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))


def random_quadratics(seed, vertices=30, count=6):
    """Of points that each candidate would take a vertex to: three equations a frame, as in
    training.
    """
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(vertices, count, 12))
    left = (rng.dirichlet(np.ones(count), vertices)[:, :, None] * rows).sum(1) + rng.normal(
        size=(vertices, 12)
    )
    return Quadratics(rows @ rows.transpose(0, 2, 1), (rows @ left[..., None])[..., 0])


def value(quadratics, weights, initial, hold):
    bent = (quadratics.matrix @ weights[..., None])[..., 0]
    return ((bent - 2 * quadratics.vector) * weights).sum(1) + hold * (
        (weights - initial) ** 2
    ).sum(1)


def dense(index, values, joints):
    out = np.zeros((len(index), joints))
    np.add.at(out, (np.arange(len(index))[:, None], index), values)
    return out


def cloud_of_weights(rng, vertices, joints):
    return rng.dirichlet(np.full(joints, 0.3), vertices)


# the best few


@pytest.mark.parametrize("hold", [0.0, 0.7])
def test_with_room_for_all_the_best_weights_meet_the_conditions_of_a_minimum(hold):
    """Karush, Kuhn and Tucker: among weights above zero slopes are equal, and none below is
    smaller.
    """
    quadratics = random_quadratics(1)
    rng = np.random.default_rng(2)
    initial = cloud_of_weights(rng, 30, 6)
    candidates = np.tile(np.arange(6), (30, 1))
    found = dense(*minimize_quadratics(quadratics, candidates, initial, hold, 6), 6)
    assert found.min() >= 0 and np.abs(found.sum(1) - 1).max() < 1e-12
    slope = (
        (quadratics.matrix @ found[..., None])[..., 0]
        - quadratics.vector
        + hold * (found - initial)
    )
    level = (slope * found).sum(1, keepdims=True)
    assert np.abs((slope - level)[found > 0]).max() < 1e-9 and (slope - level).min() > -1e-9
    assert (found == 0).any()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_best_few_are_the_best_of_all_choices(count):
    quadratics = random_quadratics(3, vertices=6, count=5)
    rng = np.random.default_rng(4)
    initial = cloud_of_weights(rng, 6, 5)
    candidates = np.tile(np.arange(5), (6, 1))
    found = dense(*minimize_quadratics(quadratics, candidates, initial, 0.3, count), 5)
    assert ((found > 0).sum(1) <= count).all()
    for v in range(6):
        alone = Quadratics(quadratics.matrix[[v]], quadratics.vector[[v]])
        choices = [
            brute_force(alone, initial[[v]], list(few)) for few in combinations(range(5), count)
        ]
        assert value(alone, found[[v]], initial[[v]], 0.3)[0] == pytest.approx(
            min(choices), abs=1e-6
        )


def brute_force(quadratics, initial, few):
    """The least energy with these candidates only, by a general optimiser."""

    def energy(x):
        weights = np.zeros_like(initial)
        weights[0, few] = x
        return value(quadratics, weights, initial, 0.3)[0]

    limit = {"type": "eq", "fun": lambda x: x.sum() - 1}
    start = np.full(len(few), 1 / len(few))
    return minimize(
        energy, start, bounds=[(0, 1)] * len(few), constraints=limit, options={"ftol": 1e-12}
    ).fun


def test_no_other_sparse_weights_are_better():
    quadratics = random_quadratics(5, count=8)
    rng = np.random.default_rng(6)
    initial = cloud_of_weights(rng, 30, 8)
    candidates = np.tile(np.arange(8), (30, 1))
    found = dense(*minimize_quadratics(quadratics, candidates, initial, 0.1, 4), 8)
    least = value(quadratics, found, initial, 0.1)
    for _ in range(500):
        other = np.zeros((30, 8))
        np.put_along_axis(
            other, rng.permuted(candidates, axis=1)[:, :4], rng.dirichlet(np.ones(4), 30), 1
        )
        assert (value(quadratics, other, initial, 0.1) >= least - 1e-9).all()


def test_only_allowed_joints_get_weight():
    quadratics = random_quadratics(7)
    rng = np.random.default_rng(8)
    candidates = rng.permuted(np.tile(np.arange(9), (30, 1)), axis=1)[:, :6]
    initial = cloud_of_weights(rng, 30, 9)
    allowed = (rng.random((30, 9)) < 0.4).astype(float)
    allowed[np.arange(30), candidates[:, 3]] = 0.2
    index, values = minimize_quadratics(quadratics, candidates, initial, 0.5, 4, allowed)
    found = dense(index, values, 9)
    assert (
        not found[allowed == 0].any()
        and np.abs(found.sum(1) - 1).max() < 1e-12
        and found.min() >= 0
    )
    assert (np.diff(values, axis=1) <= 0).all()  # strongest first
    outside = np.ones((30, 9), bool)
    np.put_along_axis(outside, candidates, False, 1)
    assert not found[outside].any()


def test_a_strong_hold_leaves_weights_where_they_are():
    initial = SMALL.weights
    candidates = candidate_joints(PARENTS, SMALL.weights)
    quadratics = random_quadratics(9, V, J)
    found = dense(*minimize_quadratics(quadratics, candidates, initial, 1e9, 4), J)
    assert np.abs(found - initial).max() < 1e-6


def test_joints_alike_do_not_matter():
    """Two candidates that do the same: the matrix is singular, the best is still found."""
    quadratics = random_quadratics(10)
    twice = np.array([0, 1, 2, 3, 4, 5, 0])
    doubled = Quadratics(quadratics.matrix[:, twice][:, :, twice], quadratics.vector[:, twice])
    candidates = np.tile(np.arange(7), (30, 1))
    initial = np.zeros((30, 7))
    found = dense(*minimize_quadratics(doubled, candidates, initial, 0.0, 4), 7)
    least = dense(*minimize_quadratics(quadratics, candidates[:, :6], initial[:, :6], 0.0, 4), 6)
    assert value(doubled, found, initial, 0) == pytest.approx(
        value(quadratics, least, initial[:, :6], 0), abs=1e-9
    )


def test_candidates_are_the_initial_joints_then_their_kin():
    parents = (-1, *range(11))  # a chain
    initial = np.zeros((2, 12))
    initial[0, [3, 4]], initial[1, [9, 0, 11]] = [0.4, 0.6], [0.5, 0.3, 0.2]
    found = candidate_joints(parents, initial)
    assert found.shape == (2, 8)
    assert found[0, :2].tolist() == [4, 3] and found[1, :3].tolist() == [9, 0, 11]
    assert set(found[0]) == {3, 4, 5, 2, 6, 1, 7, 0} and {8, 10, 7} < set(found[1])
    assert kinship(parents)[2, 7] == 5


# the data term


def test_quadratics_are_the_data_term_of_linear_skinning():
    rig = small_rig(SMALL, 1, shape_features=1)
    rng = np.random.default_rng(11)
    persons = people(SMALL, 2, 1, 1)
    some = poses(6, 1)
    targets = [
        PosedTarget(surface(rig, persons[k % 2], p) + 0.1, p, np.full(3, 0.09))
        for k, p in enumerate(some)
    ]
    items = [(persons[k % 2], target) for k, target in enumerate(targets)]
    quadratics = gather_quadratics(rig, ALL, iter(items))
    constant = sum(((t.vertices - t.trans) ** 2).sum(1) for t in targets)
    for _ in range(3):
        weights = rng.dirichlet(np.ones(J), V)
        other = replace(rig, index=ALL, value=weights)
        (direct,) = vertex_costs([other], iter(items))
        assert np.abs(value(quadratics, weights, weights, 0.0) + constant - direct).max() < 1e-10


def test_dual_quaternions_are_linearised_exactly():
    """Slope and curvature of the quadratics are those of the surface's derivatives by the
    weights.
    """
    rig = small_rig(SMALL, 2, "dqbs")
    rng = np.random.default_rng(12)
    (person,), (pose,) = people(SMALL, 1), poses(1, 2, largest=2.5)
    target = PosedTarget(
        surface(rig, person, pose) + 0.05 * rng.normal(size=(V, 3)), pose, np.zeros(3)
    )
    quadratics = gather_quadratics(rig, ALL, [(person, target)])
    wide = replace(rig, index=ALL, value=rig.weights)
    step = 1e-6
    assert np.abs(surface(wide, person, pose) - surface(rig, person, pose)).max() < 1e-14
    rows = np.empty((V, J, 3))
    for j in range(J):
        ahead, behind = (
            surface(replace(wide, value=wide.value + sign * step * np.eye(J)[j]), person, pose)
            for sign in (1, -1)
        )
        rows[:, j] = (ahead - behind) / (2 * step)
    left = target.vertices - surface(rig, person, pose)
    slope = quadratics.vector - (quadratics.matrix @ rig.weights[..., None])[..., 0]
    assert np.abs(quadratics.matrix - rows @ rows.transpose(0, 2, 1)).max() < 1e-7
    assert np.abs(slope - (rows @ left[..., None])[..., 0]).max() < 1e-8


def test_linear_weights_are_found_at_once():
    problem, truth = planted(subjects=2, each=8, weights=EnergyWeights(skinning=0.0))
    wrong = np.full((V, J), 0.02) + SMALL.weights.mean(0)
    index, values = influences(wrong, 4)
    start = replace(truth, rig=replace(truth.rig, index=index, value=values))
    problem = replace(problem, candidates=ALL, initial_weights=wrong)
    found = weight_step(problem, start, Threads(1))
    assert np.abs(found.rig.weights - truth.rig.weights).max() < 1e-6


@pytest.mark.parametrize("hold", [0.0, 1e-4])
def test_dual_quaternion_weights_are_found(hold):
    """Also where nothing holds them: they do not hear the weights' scale, which the sum settles."""
    problem, truth = planted(
        subjects=2, each=8, skinning="dqbs", weights=EnergyWeights(skinning=hold)
    )
    problem = replace(problem, candidates=ALL)
    rng = np.random.default_rng(13)
    off = np.where(SMALL.weights > 0, SMALL.weights + 0.2 * rng.random((V, J)), 0.0)
    index, values = influences(off, 4)
    estimate = replace(truth, rig=replace(truth.rig, index=index, value=values))
    begun = np.abs(estimate.rig.weights - truth.rig.weights).max()
    for _ in range(4):
        estimate = weight_step(problem, estimate, Threads(1))
    assert begun > 0.05 and np.abs(estimate.rig.weights - truth.rig.weights).max() < 1e-8


@skinnings
@pytest.mark.parametrize("hold", [1e-4, 0.05])
def test_no_vertex_gets_worse(skinning, hold):
    for seed in range(3):
        weights = EnergyWeights(skinning=hold)
        problem, truth = planted(seed=seed, skinning=skinning, noise=0.01, each=4, weights=weights)
        before = disturbed(truth, seed, 2.0)
        for _ in range(3):
            after = weight_step(problem, before, Threads(1))
            items = list(posed_targets(problem, before, range(len(problem.registrations))))
            energies = vertex_costs([before.rig, after.rig], items)
            for row, rig in zip(energies, (before.rig, after.rig), strict=True):
                row += hold * ((rig.weights - problem.initial_weights) ** 2).sum(1)
            assert (energies[1] <= energies[0] * (1 + 1e-9) + 1e-12).all()
            found = after.rig.weights
            assert (
                found.min() >= 0
                and np.abs(found.sum(1) - 1).max() < 1e-9
                and ((found > 0).sum(1) <= 4).all()
            )
            before = after


# rigs of weights


def test_halfway_lies_between_and_chosen_takes_from_each():
    one = small_rig(SMALL, count=3)
    rng = np.random.default_rng(14)
    shuffled = rng.permuted(np.arange(3)[None].repeat(V, 0), axis=1)
    other = replace(
        one, index=np.take_along_axis(one.index, shuffled, 1), value=rng.dirichlet(np.ones(3), V)
    )
    assert (
        np.abs(midpoint_rig(one, other).weights - (one.weights + other.weights) / 2).max() < 1e-15
    )
    best = rng.integers(0, 2, V)
    mixed = select_rigs([one, other], best).weights
    assert np.array_equal(mixed, np.where(best[:, None] == 0, one.weights, other.weights))


def test_vertex_energies_are_squared_distances():
    rig, (person,), (pose,) = small_rig(SMALL, 1), people(SMALL, 1), poses(1)
    away = np.random.default_rng(15).normal(size=(V, 3))
    target = PosedTarget(surface(rig, person, pose) + away + 2.0, pose, np.full(3, 2.0))
    assert vertex_costs([rig], [(person, target)] * 2)[0] == pytest.approx(
        2 * (away**2).sum(1), rel=1e-10
    )
