"""Pose blend shapes of a training problem: derivatives are the energy's, solutions those of dense
normal equations.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from small_rigs import disturbed, planted, small_body

import habitus.learn.steps.pose_shapes as pose_shapes
from habitus.body.pose_features import POSE_FEATURES
from habitus.body.skinning import SKINNING
from habitus.learn.energy import costs, measure_energy
from habitus.learn.options import EnergyWeights
from habitus.learn.posing.surface import pose_feature, surface
from habitus.learn.steps.pose_shapes import (
    Full,
    LowRank,
    Sparse,
    SparseL1,
    extended_features,
    penalty,
    solve_pose_shapes,
)
from habitus.learn.steps.poses import surface_jacobians
from habitus.parallel.workers import Threads

SMALL = small_body(pairs=3, middle=1)
V = len(SMALL.vertices)
ALONE = Threads(1)
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))


@dataclass
class Recorder:
    """A penalty of nothing that keeps what it is given."""

    given: dict = field(default_factory=dict)

    def energy(self, table):
        return 0.0

    def solve(self, start, gram, descent, curvature):
        self.given |= {"start": start, "gram": gram, "descent": descent, "curvature": curvature}
        return start


def with_table(estimate, table):
    return replace(estimate, rig=replace(estimate.rig, posedirs=table.reshape(V, 3, -1)))


def data_term(problem, estimate, table):
    return measure_energy(problem, with_table(estimate, table), ALONE).terms["data"]


def normal_equations(problem, estimate):
    """Dense, vertex by vertex: sum of (A (x) f)'(A (x) f) and of (A (x) f)' y, as (V, 3 F, 3 F) and
    (V, 3 F).
    """
    count = estimate.rig.posedirs.shape[-1]
    matrix = np.zeros((V, 3 * count, 3 * count))
    right = np.zeros((V, 3 * count))
    bare = replace(estimate.rig, posedirs=np.zeros((V, 3, count)))
    for row, who in enumerate(problem.registrations.subject_index):
        person = estimate.person(int(who))
        feature = pose_feature(estimate.rig, estimate.pose[row])
        feature = np.concatenate([feature, *(number * feature for number in person.descriptor)])
        moved, _, turn, _ = surface_jacobians(bare, person, estimate.pose[row])
        slope = (turn[:, :, :, None] * feature).reshape(V, 3, -1)
        left = problem.registrations.read(row) - estimate.trans[row] - moved
        matrix += slope.transpose(0, 2, 1) @ slope
        right += (slope.transpose(0, 2, 1) @ left[..., None])[..., 0]
    return matrix, right


def ridge(problem, estimate, weight, mask=None):
    matrix, right = normal_equations(problem, estimate)
    out = np.zeros_like(right)
    for v in range(V):
        few = np.arange(right.shape[1]) if mask is None else np.flatnonzero(np.tile(mask[v], 3))
        out[v, few] = np.linalg.solve(
            matrix[v][np.ix_(few, few)] + weight * np.eye(len(few)), right[v, few]
        )
    return out.reshape(V, 3, -1)


def noisy(skinning, seed=0, **changes):
    problem, truth = planted(
        small=SMALL, seed=seed, skinning=skinning, noise=0.01, each=10, **changes
    )
    return problem, disturbed(truth, seed, 0.3)


@skinnings
@pytest.mark.parametrize(
    "features, shape_features", [("rotations", 0), ("angles", 1), ("polynomials", 2)]
)
def test_descent_and_curvature_are_the_data_terms(monkeypatch, skinning, features, shape_features):
    problem, estimate = noisy(skinning, pose_features=features, shape_features=shape_features)
    recorder = Recorder()
    monkeypatch.setattr(pose_shapes, "penalty", lambda problem, features: recorder)
    solve_pose_shapes(problem, estimate, ALONE)
    given = recorder.given
    rng = np.random.default_rng(1)
    shape = given["start"].shape
    for _ in range(3):
        table = 0.01 * rng.normal(size=shape)
        along = rng.normal(size=shape)
        here = data_term(problem, estimate, table)
        ahead, behind = (
            data_term(problem, estimate, table + sign * 1e-2 * along) for sign in (1, -1)
        )
        bent = (given["curvature"](along) * along).sum()
        assert (ahead - behind) / 2e-2 == pytest.approx(
            -2 * (given["descent"](table) * along).sum(), rel=1e-7
        )
        assert (ahead + behind - 2 * here) / 1e-4 == pytest.approx(2 * bent, rel=1e-6)
        bound = ((along @ given["gram"]) * along).sum()
        assert bent <= bound * (1 + 1e-12)
        if skinning == "dqbs":  # rotations do not shorten
            assert bent == pytest.approx(bound, rel=1e-10)


@pytest.mark.parametrize("features", list(POSE_FEATURES))
def test_features_are_those_of_the_rig(features):
    problem, estimate = noisy("lbs", pose_features=features, shape_features=2)
    table = np.random.default_rng(2).normal(size=(V, 3, estimate.rig.posedirs.shape[-1]))
    rows = extended_features(problem, estimate)
    rig = replace(estimate.rig, posedirs=table)
    for k, who in enumerate(problem.registrations.subject_index):
        alone = rig.posedirs_for(estimate.descriptors[who]) @ pose_feature(rig, estimate.pose[k])
        assert np.abs(table @ rows[k] - alone).max() < 1e-12


@pytest.mark.parametrize("shape_features", [0, 1])
@pytest.mark.parametrize("weight", [0.05, 25.0])
def test_full_is_ridge_regression_at_once_with_dual_quaternions(weight, shape_features):
    changes = {"weights": EnergyWeights(pose_shapes=weight), "shape_features": shape_features}
    problem, estimate = noisy("dqbs", **changes)
    wanted = ridge(problem, estimate, weight)
    assert (
        np.abs(solve_pose_shapes(problem, estimate, ALONE) - wanted).max()
        < 1e-9 * np.abs(wanted).max()
    )


def test_full_becomes_ridge_regression_with_linear_skinning():
    problem, estimate = noisy("lbs", weights=EnergyWeights(pose_shapes=0.5))
    wanted = ridge(problem, estimate, 0.5)
    for _ in range(4):
        estimate = with_table(estimate, solve_pose_shapes(problem, estimate, ALONE))
    assert np.abs(estimate.rig.posedirs - wanted).max() < 1e-6 * np.abs(wanted).max()


@skinnings
@pytest.mark.parametrize("shape_features", [0, 1])
def test_sparse_blend_shapes_hear_only_joints_that_move_a_vertex(skinning, shape_features):
    weights = EnergyWeights(pose_shapes=0.5)
    changes = {"weights": weights, "shape_features": shape_features, "pose_shapes": "sparse"}
    problem, estimate = noisy(skinning, **changes)
    for _ in range(4):
        estimate = with_table(estimate, solve_pose_shapes(problem, estimate, ALONE))
    found = estimate.rig.posedirs
    joints = problem.initial_weights[:, 1:] > 0
    mask = np.concatenate([np.repeat(joints, 9, axis=1)] * (1 + shape_features), 1)
    blocks = found.reshape(V, 3, 1 + shape_features, joints.shape[1], 9)
    assert not np.moveaxis(blocks, 3, 1)[~joints].any() and joints.any() and not joints.all()
    wanted = ridge(problem, estimate, 0.5, mask)
    assert np.abs(found - wanted).max() < 1e-6 * np.abs(wanted).max()


def test_planted_blend_shapes_are_found():
    problem, truth = planted(small=SMALL, each=26, weights=EnergyWeights(pose_shapes=1e-9))
    estimate = with_table(truth, np.zeros_like(truth.rig.posedirs))
    for _ in range(6):
        estimate = with_table(estimate, solve_pose_shapes(problem, estimate, ALONE))
    assert np.abs(estimate.rig.posedirs - truth.rig.posedirs).max() < 1e-5
    person = truth.person(0)
    apart = surface(estimate.rig, person, truth.pose[0]) - surface(truth.rig, person, truth.pose[0])
    assert np.abs(apart).max() < 1e-7


@skinnings
@pytest.mark.parametrize("kind", ["full", "sparse", "low_rank", "l1"])
def test_energy_never_rises(skinning, kind):
    changes = {
        "pose_shapes": kind,
        "rank": 4,
        "l1": 0.02,
        "weights": EnergyWeights(pose_shapes=0.5),
    }
    problem, estimate = noisy(skinning, shape_features=1, **changes)
    before = measure_energy(problem, estimate, ALONE).total
    for _ in range(3):
        estimate = with_table(estimate, solve_pose_shapes(problem, estimate, ALONE))
        after = measure_energy(problem, estimate, ALONE).total
        assert after <= before * (1 + 1e-12)
        before = after
    if kind == "low_rank":
        assert np.linalg.matrix_rank(estimate.rig.posedirs.reshape(3 * V, -1), tol=1e-10) == 4


def test_the_penalty_is_the_one_asked_for():
    weights = EnergyWeights(pose_shapes=3.0)
    for kind, wanted in (
        ("full", Full(3.0)),
        ("low_rank", LowRank(3.0, 7)),
        ("l1", SparseL1(0.2)),
    ):
        problem, truth = planted(small=SMALL, pose_shapes=kind, rank=7, l1=0.2, weights=weights)
        assert penalty(problem, truth.rig.posedirs.shape[-1]) == wanted
    problem, truth = planted(small=SMALL, pose_shapes="sparse", weights=weights)
    found = penalty(problem, truth.rig.posedirs.shape[-1])
    assert isinstance(found, Sparse) and found.weight == 3.0
    table = np.ones((2, 5)) * [1.0, -2.0, 0.0, 0.5, 1.0]
    energies = [
        costs({"": each.term}, {"posedirs": table})[""]
        for each in (Full(3.0), LowRank(3.0, 7), found)
    ]
    assert energies == [3 * 2 * 6.25] * 3
    assert costs({"": SparseL1(0.2).term}, {"posedirs": table})[""] == pytest.approx(0.2 * 2 * 4.5)
