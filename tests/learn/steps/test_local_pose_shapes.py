"""Local pose blend shapes: the exact minimum over the joints near a vertex, and those that matter
among them.
"""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import PARENTS, planted, small_body

from habitus.body.skinning import SKINNING
from habitus.learn.energy import measure_energy
from habitus.learn.options import EnergyWeights
from habitus.learn.steps.local_pose_shapes import halves, kept_groups, neighbourhoods
from habitus.learn.steps.pose_shapes import let_go, solve_pose_shapes
from habitus.parallel.workers import Threads

SMALL = small_body(pairs=3, middle=1)
ALONE = Threads(1)
JOINTS = len(PARENTS) - 1


def driving(posedirs):
    """Which joints drive which vertices (V, J-1)."""
    return posedirs.reshape(len(posedirs), 3, JOINTS, 9).any((1, 3))


def problem_of(**changes):
    """A problem whose people's flesh is driven by one or two joints a vertex, among those near
    it.
    """
    weights = EnergyWeights(pose_shapes=changes.pop("weight", 1e-6))
    problem, truth = planted(
        small=SMALL, subjects=4, each=20, weights=weights, pose_shapes="local", **changes
    )
    rng = np.random.default_rng(5)
    near = SMALL.weights[:, 1:] > 0.05
    near &= rng.random(near.shape) < 0.7
    sparse = truth.rig.posedirs * np.repeat(near, 9, 1)[:, None]
    truth = replace(truth, rig=replace(truth.rig, posedirs=sparse))
    vertices = problem.registrations.vertices.copy()
    from habitus.learn.posing.surface import surface  # registrations of the thinned truth

    for row, who in enumerate(problem.registrations.subject_index):
        vertices[row] = (
            surface(truth.rig, truth.person(int(who)), truth.pose[row]) + truth.trans[row]
        )
    return (
        replace(problem, registrations=replace(problem.registrations, vertices=vertices)),
        truth,
        near,
    )


def bare(estimate):
    return replace(
        estimate, rig=replace(estimate.rig, posedirs=np.zeros_like(estimate.rig.posedirs))
    )


@pytest.mark.parametrize("skinning", list(SKINNING))
def test_planted_local_blend_shapes_are_found_with_the_joints_that_drive_them(skinning):
    problem, truth, near = problem_of(skinning=skinning)
    found = solve_pose_shapes(problem, bare(truth), ALONE)
    assert np.abs(found - truth.rig.posedirs).max() < 0.02 * np.abs(truth.rig.posedirs).max()
    free = replace(truth, rig=replace(truth.rig, posedirs=found))
    chosen = let_go(problem, free, ALONE).rig.posedirs
    assert np.array_equal(driving(chosen), near)
    assert np.abs(chosen - truth.rig.posedirs).max() < 1e-3 * np.abs(truth.rig.posedirs).max()


@pytest.mark.parametrize("prior", [0.0, 0.05])
def test_the_step_is_the_minimum_over_the_joints_near_a_vertex(prior):
    """No small change of what may drive a vertex lowers the energy; others stay zero."""
    problem, truth, _ = problem_of(weight=0.5, noise=2e-3, rotation_prior=prior)
    start = bare(truth)
    table = solve_pose_shapes(problem, start, ALONE)
    best = replace(truth, rig=replace(truth.rig, posedirs=table))
    columns = np.arange(9 * JOINTS).reshape(JOINTS, 9)
    allowed = neighbourhoods(problem, start, np.ones(JOINTS, bool), columns)
    assert not allowed.all() and not (driving(table) & ~allowed).any()
    energy = measure_energy(problem, best, ALONE).total
    rng = np.random.default_rng(0)
    assert energy < measure_energy(problem, start, ALONE).total
    for _ in range(5):
        away = 1e-5 * rng.normal(size=table.shape) * np.repeat(allowed, 9, 1)[:, None]
        for side in (1, -1):
            moved = replace(best, rig=replace(best.rig, posedirs=table + side * away))
            assert measure_energy(problem, moved, ALONE).total > energy


def test_weights_count_and_vertices_that_nobody_shows_keep_what_they_had():
    problem, truth, _ = problem_of(weight=0.1, noise=2e-3)
    data = problem.registrations
    rng = np.random.default_rng(1)
    weights = np.where(rng.random(data.num_vertices) < 0.3, 0.0, 0.5)
    spoilt = data.vertices + (weights == 0)[:, None] * rng.normal(size=(len(data), 1, 3))
    given = replace(
        problem, registrations=replace(data, vertices=spoilt, weights=weights), weighted=True
    )
    found = solve_pose_shapes(given, truth, ALONE)
    assert np.array_equal(found[weights == 0], truth.rig.posedirs[weights == 0])
    halved = replace(
        problem, options=replace(problem.options, weights=EnergyWeights(pose_shapes=0.2))
    )
    alike = solve_pose_shapes(halved, truth, ALONE)[weights > 0]
    np.testing.assert_allclose(found[weights > 0], alike, atol=1e-9)


def test_halves_hold_people_and_their_mirror_images_together():
    assert halves(np.array([0, 0, 1, 2, 3, 3, 4])).tolist() == [0, 0, 0, 1, 1, 1, 0]
    assert halves(np.array([0, 0, 1, 1])).tolist() == [0, 1, 0, 1]


def test_letting_go_is_judged_by_the_other_half():
    """A group that explains one half's noise alone costs the other nothing; one that both share
    stays.
    """
    rng = np.random.default_rng(2)
    columns = [rng.normal(size=(30, 6)) for _ in range(2)]
    truth = np.array([1.0, -1.0, 0, 0, 0, 0])
    values = [one @ truth + 0.1 * rng.normal(size=30) for one in columns]
    values[0] += columns[0][:, 2] * 0.3  # nothing of it in the other half
    grams = [one.T @ one for one in columns]
    pulls = [one.T @ y for one, y in zip(columns, values, strict=True)]
    groups = np.arange(6).reshape(3, 2)
    assert kept_groups(grams, pulls, 1e-6 * np.eye(6), groups, 1.0).tolist() == [0]
    assert not len(kept_groups(grams, pulls, 1e-6 * np.eye(6), groups, 1e9))


def test_what_letting_go_costs_is_what_it_costs():
    """The first to go is the one whose loss, all else solved for again, the other halves feel
    least.
    """
    rng = np.random.default_rng(3)
    columns = [rng.normal(size=(40, 8)) for _ in range(2)]
    values = [
        one @ np.array([1.0, 1, 0.1, 0.1, -0.5, 0.5, 0, 0.3]) + 0.2 * rng.normal(size=40)
        for one in columns
    ]
    groups = rng.permutation(8).reshape(4, 2)

    def cost(kept):
        """Both halves' squares, each with what the other gives."""
        total = 0.0
        for one, other in ((0, 1), (1, 0)):
            use = columns[one][:, kept]
            found = np.linalg.solve(use.T @ use + 0.05 * np.eye(len(kept)), use.T @ values[one])
            total += ((columns[other][:, kept] @ found - values[other]) ** 2).sum()
        return total

    left = list(range(4))
    limit = 12.0
    while left:
        costs = [
            cost(groups[[g for g in left if g != k]].ravel()) - cost(groups[left].ravel())
            for k in left
        ]
        if min(costs) >= limit:
            break
        left.pop(int(np.argmin(costs)))
    grams = [one.T @ one for one in columns]
    pulls = [one.T @ y for one, y in zip(columns, values, strict=True)]
    assert (
        kept_groups(grams, pulls, 0.1 * np.eye(8), groups, limit).tolist() == left
        and 0 < len(left) < 4
    )
