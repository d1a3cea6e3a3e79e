"""Penalties on pose blend shapes: each lowers data term and penalty together, and keeps what it
promises.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from habitus.learn.energy import costs
from habitus.learn.steps.pose_shapes import Full, LowRank, Sparse, SparseL1

V = 10
F = 12
N = 40


@dataclass
class Data:
    """Residuals y_n - A_n P f_n, A_n one 3x3 matrix a vertex; features f of unlike sizes, some of
    them alike.
    """

    blends: np.ndarray
    features: np.ndarray
    targets: np.ndarray

    @property
    def gram(self):
        return self.features.T @ self.features

    def residual(self, table):
        moved = (table @ self.features.T).reshape(V, 3, N)
        return self.targets - np.einsum("nvab,vbn->nva", self.blends, moved)

    def energy(self, table):
        return (self.residual(table) ** 2).sum()

    def descent(self, table):
        return np.einsum(
            "nvab,nva,nf->vbf", self.blends, self.residual(table), self.features
        ).reshape(3 * V, F)

    def curvature(self, along):
        bent = np.einsum("nvab,vbn->nva", self.blends, (along @ self.features.T).reshape(V, 3, N))
        return np.einsum("nvab,nva,nf->vbf", self.blends, bent, self.features).reshape(3 * V, F)

    def matrix(self):
        """Half the second derivative as a dense matrix (3VF, 3VF)."""
        units = np.eye(3 * V * F).reshape(-1, 3 * V, F)
        return np.stack([self.curvature(unit).ravel() for unit in units])


def data(seed=0, shortest=1.0):
    """Rotations where ``shortest`` is 1, else blends that shorten down to that."""
    rng = np.random.default_rng(seed)
    blends = np.linalg.qr(rng.normal(size=(N, V, 3, 3)))[0] * rng.uniform(
        shortest, 1.0, (N, V, 1, 3)
    )
    features = rng.normal(size=(N, F)) * np.geomspace(0.1, 2.0, F)
    features[:, 1] += features[:, 0]
    return Data(blends, features, 0.05 * rng.normal(size=(N, V, 3)))


def total(penalty, given, table):
    return given.energy(table) + costs({"": penalty.term}, {"posedirs": table})[""]


def solve(penalty, given, start, times=1):
    for _ in range(times):
        start = penalty.solve(start, given.gram, given.descent, given.curvature)
    return start


def ridge(given, weight, mask=None):
    """The dense normal equations, where a mask is given among its entries only."""
    few = np.arange(3 * V * F) if mask is None else np.flatnonzero(mask)
    matrix = given.matrix()[np.ix_(few, few)] + weight * np.eye(len(few))
    table = np.zeros(3 * V * F)
    table[few] = np.linalg.solve(matrix, given.descent(np.zeros((3 * V, F))).ravel()[few])
    return table.reshape(3 * V, F)


def driven(seed=0):
    mask = np.random.default_rng(seed).random((V, F)) < 0.4
    mask[0] = False  # nothing drives this vertex
    mask[1] = mask[2]
    return mask


ALL = [Full(0.7), Full(25.0), Sparse(0.7, driven()), LowRank(0.7, 3), SparseL1(0.05), SparseL1(0.3)]
every = pytest.mark.parametrize("penalty", ALL, ids=lambda p: f"{type(p).__name__}-{p.weight}")


def test_the_test_data_are_consistent():
    given = data(1, 0.3)
    rng = np.random.default_rng(2)
    table, along = rng.normal(size=(2, 3 * V, F))
    step = 1e-4
    ahead = given.energy(table + step * along)
    behind = given.energy(table - step * along)
    here = given.energy(table)
    assert (ahead - behind) / (2 * step) == pytest.approx(
        -2 * (given.descent(table) * along).sum(), rel=1e-8
    )
    assert (ahead + behind - 2 * here) / step**2 == pytest.approx(
        2 * (given.curvature(along) * along).sum(), rel=1e-4
    )
    assert (given.curvature(along) * along).sum() <= (along @ given.gram * along).sum()


@every
@pytest.mark.parametrize("shortest", [1.0, 0.2])
def test_energy_never_rises(penalty, shortest):
    for seed in range(3):
        given = data(seed, shortest)
        table = np.zeros((3 * V, F))
        before = total(penalty, given, table)
        for _ in range(6):
            table = solve(penalty, given, table)
            after = total(penalty, given, table)
            assert after <= before * (1 + 1e-12)
            before = after
        assert before < total(penalty, given, np.zeros((3 * V, F)))


@every
def test_what_is_solved_stays(penalty):
    given = data(3)
    found = solve(penalty, given, np.zeros((3 * V, F)), 150)
    assert np.abs(solve(penalty, given, found) - found).max() < 1e-6 * np.abs(found).max()


@pytest.mark.parametrize("weight", [0.0, 0.7, 25.0])
def test_full_is_ridge_regression_at_once_where_blends_are_rotations(weight):
    given = data(4)
    start = np.random.default_rng(5).normal(size=(3 * V, F))
    assert np.abs(solve(Full(weight), given, start) - ridge(given, weight)).max() < 1e-10


@pytest.mark.parametrize("shortest", [0.7, 0.2])
def test_full_becomes_ridge_regression_where_blends_shorten(shortest):
    given = data(5, shortest)
    wanted = ridge(given, 0.7)
    assert (
        np.abs(solve(Full(0.7), given, np.zeros((3 * V, F)), 12) - wanted).max()
        < 1e-6 * np.abs(wanted).max()
    )


@pytest.mark.parametrize("shortest, times", [(1.0, 1), (0.3, 12)])
def test_sparse_is_ridge_regression_among_what_drives(shortest, times):
    given = data(6, shortest)
    mask = driven()
    start = np.random.default_rng(7).normal(size=(3 * V, F))  # what may not drive is dropped
    found = solve(Sparse(0.7, mask), given, start, times)
    rows = np.repeat(mask, 3, axis=0)
    assert not found[~rows].any() and (found[rows] != 0).all()
    wanted = ridge(given, 0.7, rows.ravel())
    assert np.abs(found - wanted).max() < 1e-6 * np.abs(wanted).max()


def test_sparse_where_everything_drives_is_full():
    given = data(7, 0.4)
    start = np.zeros((3 * V, F))
    sparse = solve(Sparse(0.7, np.ones((V, F), bool)), given, start)
    assert np.abs(sparse - solve(Full(0.7), given, start)).max() < 1e-12


@pytest.mark.parametrize("rank", [1, 4])
def test_low_rank_has_its_rank_and_is_the_best_of_it_where_blends_are_rotations(rank):
    given = data(8)
    found = solve(LowRank(0.7, rank), given, np.zeros((3 * V, F)))
    sizes = np.linalg.svd(found, compute_uv=False)
    assert sizes[rank - 1] > 1e-4 and sizes[rank] < 1e-12
    root = np.linalg.cholesky(given.gram + 0.7 * np.eye(F))
    stretched = np.linalg.svd(ridge(given, 0.7) @ root, compute_uv=False)
    whole = total(Full(0.7), given, ridge(given, 0.7))
    best = (
        whole + (stretched[rank:] ** 2).sum()
    )  # Eckart, Young: what the other directions would have gained
    assert total(LowRank(0.7, rank), given, found) == pytest.approx(best, rel=1e-10)


def test_low_rank_with_room_is_full():
    given = data(9)
    found = solve(LowRank(0.7, 99), given, np.zeros((3 * V, F)))
    assert np.abs(found - ridge(given, 0.7)).max() < 1e-10


@pytest.mark.parametrize("shortest", [1.0, 0.4])
@pytest.mark.parametrize("weight", [0.05, 0.5])
def test_l1_meets_the_conditions_of_a_minimum(weight, shortest):
    """At numbers other than zero the slope is the weight, at zero it is no larger."""
    given = data(10, shortest)
    found = solve(SparseL1(weight), given, np.zeros((3 * V, F)), 150)
    slope = 2 * given.descent(found)
    zero = found == 0
    assert 0.05 < zero.mean() < 0.98
    assert np.abs(slope - weight * np.sign(found))[~zero].max() < 1e-4 * weight
    assert np.abs(slope[zero]).max() <= weight * (1 + 1e-4)


def test_more_l1_leaves_fewer_numbers():
    given = data(11)
    start = np.zeros((3 * V, F))
    counts = [
        (solve(SparseL1(weight), given, start, 20) != 0).sum() for weight in (0.0, 0.05, 0.5, 1e3)
    ]
    assert counts[0] == 3 * V * F and counts[0] > counts[1] > counts[2] > counts[3] == 0


@pytest.mark.parametrize("penalty", ALL[:5], ids=lambda p: f"{type(p).__name__}-{p.weight}")
def test_targets_twice_as_far_give_tables_twice_as_large(penalty):
    given = data(12, 0.5)
    doubled = Data(given.blends, given.features, 2 * given.targets)
    start = np.zeros((3 * V, F))
    stronger = SparseL1(2 * penalty.weight) if isinstance(penalty, SparseL1) else penalty
    one = solve(penalty, given, start, 3)
    two = solve(stronger, doubled, start, 3)
    assert np.abs(two - 2 * one).max() < 1e-10 * np.abs(one).max() and np.abs(one).max() > 1e-3


@every
def test_a_feature_that_is_always_zero_drives_nothing(penalty):
    given = data(13)
    given.features[:, 4] = 0
    found = solve(penalty, given, np.zeros((3 * V, F)), 2)
    assert np.isfinite(found).all() and np.abs(found[:, 4]).max() < 1e-12


@pytest.mark.parametrize("kind", [Full, LowRank, Sparse, SparseL1])
def test_nothing_need_hold_blend_shapes(kind):
    """Not even where features are alike, so that the Gram matrix is singular."""
    given = data(14)
    given.features[:, 4] = given.features[:, 5] = 0
    more = {Full: (), LowRank: (3,), Sparse: (driven(),), SparseL1: ()}[kind]
    found = solve(kind(0.0, *more), given, np.zeros((3 * V, F)))
    assert np.isfinite(found).all() and given.energy(found) < given.energy(np.zeros((3 * V, F)))
