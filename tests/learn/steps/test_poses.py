"""Poses of registrations: the place is eliminated exactly, planted poses are found from afar,
nothing gets worse.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_rigs import people, poses, small_body, small_rig

from habitus.body.pose_features import POSE_FEATURES
from habitus.body.skinning import SKINNING
from habitus.learn.posing.rig import RestPerson
from habitus.learn.posing.surface import surface
from habitus.learn.start.first_estimate import edge_pose, pose_by_parts
from habitus.learn.steps.poses import (
    VertexDistance,
    edge_distance,
    fit_pose,
    pose_terms,
    surface_jacobians,
)
from habitus.rotations import matrix_from_rotvec

SMALL = small_body()
EDGES = edge_distance(SMALL.faces, len(SMALL.vertices))
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))
features = pytest.mark.parametrize("features", list(POSE_FEATURES))


def matrices(pose):
    return matrix_from_rotvec(torch.from_numpy(pose)).numpy()


def squares_after_the_best_shift(rig, person, pose, target):
    apart = target - surface(rig, person, pose)
    return float(((apart - apart.mean(0)) ** 2).sum())


# what counts


def test_places_are_solved_for():
    rng = np.random.default_rng(0)
    difference = rng.normal(size=(20, 3))
    rows = rng.normal(size=(20, 3, 5))
    shift = np.tile(np.eye(3), (20, 1, 1))
    flat = rows.reshape(-1, 5)
    moved = shift.reshape(-1, 3)
    best, *_ = np.linalg.lstsq(moved, -difference.ravel(), rcond=None)
    assert VertexDistance().energy(difference) == pytest.approx(
        ((difference + best) ** 2).sum(), rel=1e-12
    )
    gradient, matrix = VertexDistance().normal_equations(difference, rows)
    whole = np.hstack([flat, moved])
    pull = np.hstack([flat, moved]).T @ difference.ravel()
    both = np.linalg.pinv(whole.T @ whole)
    assert np.abs(np.linalg.inv(matrix) - both[:5, :5]).max() < 1e-12  # the Schur complement
    assert np.abs(np.linalg.solve(matrix, gradient) - (both @ pull)[:5]).max() < 1e-12


def test_edges_are_counted_once():
    rng = np.random.default_rng(1)
    faces = np.array([[0, 1, 2], [2, 1, 3], [3, 4, 0]])
    edges = {frozenset(pair) for a, b, c in faces.tolist() for pair in ((a, b), (b, c), (c, a))}
    assert len(edges) == 8
    difference = rng.normal(size=(5, 3))
    rows = rng.normal(size=(5, 3, 4))
    total = 0.0
    gradient = np.zeros(4)
    matrix = np.zeros((4, 4))
    for a, b in edges:
        apart = difference[a] - difference[b]
        slope = rows[a] - rows[b]
        total = total + apart @ apart
        gradient = gradient + slope.T @ apart
        matrix = matrix + slope.T @ slope
    distance = edge_distance(faces, 5)
    found = distance.normal_equations(difference, rows)
    assert distance.energy(difference) == pytest.approx(total, rel=1e-12)
    assert np.abs(found[0] - gradient).max() < 1e-12 and np.abs(found[1] - matrix).max() < 1e-12
    assert distance.energy(difference + np.arange(3.0)) == pytest.approx(total, rel=1e-12)


@skinnings
@pytest.mark.parametrize("distance", [VertexDistance(), EDGES], ids=["vertices", "edges"])
def test_the_fused_normal_equations_are_those_of_the_term(skinning, distance):
    rig, (person,), (pose, other) = (
        small_rig(SMALL, 3, skinning),
        people(SMALL, 1),
        poses(2, seed=9),
    )
    target = surface(rig, person, other) + np.arange(3)
    (term,) = pose_terms(rig, person, target, distance).values()
    outcome = term({"pose": pose})
    residual = np.asarray(outcome.value)
    jacobian = outcome.jacobians()["pose"]
    moved, pose_jacobian, *_ = surface_jacobians(rig, person, pose)
    gradient, matrix = distance.normal_equations(moved - target, pose_jacobian)
    assert term.weight * float(outcome.cost) == pytest.approx(
        distance.energy(moved - target), rel=1e-12
    )
    assert np.abs(jacobian.T @ residual - gradient).max() < 1e-11 * np.abs(gradient).max()
    assert np.abs(jacobian.T @ jacobian - matrix).max() < 1e-11 * np.abs(matrix).max()
    fit = fit_pose(rig, person, target, pose, distance=distance)
    assert fit.energy == pytest.approx(
        term.weight * float(term({"pose": fit.pose}).cost), rel=1e-6, abs=1e-12
    )
    assert fit.energy < term.weight * float(outcome.cost)


# what is found


@skinnings
@features
def test_planted_poses_are_found_from_afar(skinning, features):
    rig, (person,) = small_rig(SMALL, 2, skinning, features, 1), people(SMALL, 1, 2, 1)
    for k, pose in enumerate(poses(3, seed=6, largest=1.4)):
        pose[0] *= 2  # people stand in any direction
        place = np.array([3.0, -1.0, 0.5])
        target = surface(rig, person, pose) + place
        rough = edge_pose(rig, person, SMALL.part, target, None, EDGES)
        assert rough.energy < 1e-6, k
        fit = fit_pose(rig, person, target, rough.pose, max_iterations=20)
        assert np.abs(matrices(fit.pose) - matrices(pose)).max() < 1e-6
        assert np.abs(fit.trans - place).max() < 1e-7 and fit.energy < 1e-12


@skinnings
def test_poses_by_edges_hardly_hear_of_shape(skinning):
    rig = small_rig(SMALL, 2, skinning, size=None)
    person, other = people(SMALL, 2, 3, variation=0.02)
    for pose in poses(3, seed=7):
        target = surface(rig, other, pose)
        fit = edge_pose(rig, person, SMALL.part, target, None, EDGES)
        turned = np.swapaxes(matrices(fit.pose), 1, 2) @ matrices(pose)
        assert np.arccos(((np.trace(turned, axis1=1, axis2=2) - 1) / 2).clip(-1, 1)).max() < 0.35


def test_rigid_parts_are_turned_exactly():
    rig, (person,) = small_rig(SMALL, size=None), people(SMALL, 1)
    stiff = replace(rig, index=SMALL.part[:, None], value=np.ones((len(SMALL.part), 1)))
    for pose in poses(4, seed=8, largest=3.0):
        found = pose_by_parts(
            person.template, surface(stiff, person, pose) + np.arange(3), SMALL.part, rig.parents
        )
        assert np.abs(matrices(found) - matrices(pose)).max() < 1e-12


def test_a_part_too_small_to_tell_turns_with_its_parent():
    rig, (person,) = small_rig(SMALL, size=None), people(SMALL, 1)
    part = SMALL.part.copy()
    part[np.flatnonzero(part == 5)[3:]] = 3
    (pose,) = poses(1, seed=8)
    assert not pose_by_parts(person.template, surface(rig, person, pose), part, rig.parents)[
        5
    ].any()


@skinnings
def test_the_best_pose_of_a_noisy_registration_has_no_slope(skinning):
    rig, (person,), (pose,) = small_rig(SMALL, 3, skinning), people(SMALL, 1), poses(1, seed=9)
    target = surface(rig, person, pose) + 0.01 * np.random.default_rng(4).normal(
        size=SMALL.vertices.shape
    )
    fit = fit_pose(rig, person, target, pose, max_iterations=50)
    assert squares_after_the_best_shift(rig, person, fit.pose, target) == pytest.approx(
        fit.energy, rel=1e-9
    )
    for along in np.eye(pose.size).reshape(-1, *pose.shape):
        up, down = (
            squares_after_the_best_shift(rig, person, fit.pose + s * 1e-4 * along, target)
            for s in (1, -1)
        )
        assert min(up, down) > fit.energy and abs(up - down) < 2e-2 * (up + down - 2 * fit.energy)


@skinnings
@features
@pytest.mark.parametrize("afar", [False, True])
def test_the_energy_never_rises_and_is_what_is_said(skinning, features, afar):
    """From afar joints turn beyond half a turn on the way: not all features are the same for the
    short way round.
    """
    rig, (person,) = small_rig(SMALL, 3, skinning, features), people(SMALL, 1)
    rng = np.random.default_rng(5)
    for pose, far in zip(poses(8, seed=10), poses(8, seed=11, largest=3.1), strict=True):
        target = surface(rig, person, pose) + 0.02 * rng.normal(size=SMALL.vertices.shape)
        start = far if afar else pose + 0.2 * rng.normal(size=pose.shape)
        before = squares_after_the_best_shift(rig, person, start, target)
        for iterations in (1, 3):
            fit = fit_pose(rig, person, target, start, max_iterations=iterations)
            after = ((surface(rig, person, fit.pose) + fit.trans - target) ** 2).sum()
            assert after <= before * (1 + 1e-12)
            assert after == pytest.approx(fit.energy, rel=1e-9)


@pytest.mark.parametrize("features", ["rotations", "quaternions"])
def test_poses_come_back_the_short_way(features):
    rig, (person,) = small_rig(SMALL, 3, features=features), people(SMALL, 1)
    for pose in poses(5, seed=12, largest=3.0):
        angle = np.linalg.norm(pose, axis=1, keepdims=True)
        for turns in (-1, 1, 2):
            long = pose * (1 + 2 * np.pi * turns / angle)
            target = surface(rig, person, pose)
            fit = fit_pose(rig, person, target, long, max_iterations=1)
            assert np.linalg.norm(fit.pose, axis=1).max() <= np.pi + 1e-12
            assert np.abs(surface(rig, person, fit.pose) + fit.trans - target).max() < 1e-6


def test_people_need_not_be_where_the_regressor_says():
    rig, (person,), (pose,) = small_rig(SMALL, 3), people(SMALL, 1), poses(1, seed=13)
    person = RestPerson(person.template, person.joints + 0.03, person.descriptor)
    target = surface(rig, person, pose)
    fit = fit_pose(rig, person, target, pose + 0.1, max_iterations=30)
    assert np.abs(surface(rig, person, fit.pose) + fit.trans - target).max() < 1e-7
