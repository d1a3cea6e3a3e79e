"""The joint regressor: planted ones are found, and it moves and mirrors with its subjects."""

import numpy as np
import pytest
import scipy.optimize

from habitus.errors import HabitusError
from habitus.learn.options import TrainSettings
from habitus.learn.shape import joint_regressor
from habitus.learn.shape.joint_regressor import fit_joint_regressor

V = 120
J = 5
MIRROR = np.arange(V).reshape(-1, 2)[:, ::-1].ravel()  # neighbours are partners
JOINT_MIRROR = np.array([0, 2, 1, 4, 3])
FLIP = np.array([-1.0, 1.0, 1.0])


def subjects(count, seed=0, variation=0.05):
    """Surfaces that vary about one which is symmetric, without being symmetric themselves."""
    rng = np.random.default_rng(seed)
    base = np.random.default_rng(99).normal(size=(V, 3)) * 0.3
    base = (base + base[MIRROR] * FLIP) / 2
    return base + variation * rng.normal(size=(count, V, 3))


def planted(seed=1, weights=6):
    """A sparse, convex, symmetric regressor."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((J, V))
    for row in rows:
        row[rng.permutation(V)[:weights]] = rng.dirichlet(np.ones(weights))
    rows = (rows + rows[JOINT_MIRROR][:, MIRROR]) / 2
    return rows / rows.sum(1, keepdims=True)


def held_out_error(regressor, truth, seed=7):
    return np.linalg.norm((regressor - truth) @ subjects(20, seed), axis=-1).max()


@pytest.mark.parametrize("mirrors", [{}, {"mirror": MIRROR, "joint_mirror": JOINT_MIRROR}])
@pytest.mark.parametrize("count", [25, 60])  # fewer and more equations than vertices
def test_a_planted_regressor_is_found(count, mirrors):
    truth = planted()
    templates = subjects(count)
    found = fit_joint_regressor(templates, truth @ templates, nearness=0.0, **mirrors)
    assert held_out_error(found, truth) < 1e-6
    assert np.abs(found - truth).max() < 1e-6
    usual = fit_joint_regressor(templates, truth @ templates, **mirrors)
    assert held_out_error(usual, truth) < 5e-4


@pytest.mark.parametrize("count", [1, 2, 3, 40])
def test_rows_are_sparse_shares(count):
    templates = subjects(count)
    joints = planted() @ templates + 0.01 * np.random.default_rng(5).normal(size=(count, J, 3))
    found = fit_joint_regressor(templates, joints)
    assert (found >= 0).all() and np.abs(found.sum(1) - 1).max() < 1e-14
    assert (found > 0).sum(1).max() <= min(3 * count + 2, 60)


def test_a_row_is_the_nearest_point_of_the_convex_hull():
    templates = subjects(2)
    joints = 0.6 + np.zeros((2, 1, 3))
    found = fit_joint_regressor(templates, joints, nearness=0.0)
    away = (templates - joints).transpose(0, 2, 1).reshape(6, V)
    gradient = away.T @ (away @ found[0])
    assert (
        gradient.min() >= gradient @ found[0] - 1e-10
    )  # no vertex is a way down: Karush, Kuhn and Tucker
    slow = scipy.optimize.minimize(
        lambda x: ((away @ (x**2) / (x**2).sum()) ** 2).sum(),
        np.ones(V),
        method="L-BFGS-B",
        options={"maxiter": 5000},
    )
    assert ((away @ found[0]) ** 2).sum() <= slow.fun + 1e-12


def test_how_firmly_the_sum_is_held_does_not_matter(monkeypatch):
    templates = subjects(10)
    joints = planted() @ templates + 0.02
    monkeypatch.setattr(joint_regressor, "SUM_WEIGHT", 0.03)
    one = fit_joint_regressor(templates, joints)
    monkeypatch.setattr(joint_regressor, "SUM_WEIGHT", 30.0)
    assert np.abs(one - fit_joint_regressor(templates, joints)).max() < 1e-8


def test_where_subjects_stand_and_in_which_order_does_not_matter():
    templates = subjects(12)
    joints = planted() @ templates + 0.01 * np.random.default_rng(2).normal(size=(12, J, 3))
    found = fit_joint_regressor(templates, joints)
    place = np.random.default_rng(3).normal(size=(12, 1, 3))
    assert np.abs(fit_joint_regressor(templates + place, joints + place) - found).max() < 1e-9
    assert np.abs(fit_joint_regressor(templates[::-1], joints[::-1]) - found).max() < 1e-9


def test_mirrored_subjects_give_the_mirrored_regressor():
    templates = subjects(12)
    joints = planted() @ templates + 0.01 * np.random.default_rng(2).normal(size=(12, J, 3))
    candidates = np.random.default_rng(4).random((J, V)) < 0.8
    found = fit_joint_regressor(templates, joints, candidates=candidates)
    mirrored = fit_joint_regressor(
        templates[:, MIRROR] * FLIP,
        joints[:, JOINT_MIRROR] * FLIP,
        candidates=candidates[JOINT_MIRROR][:, MIRROR],
    )
    assert np.abs(mirrored - found[JOINT_MIRROR][:, MIRROR]).max() < 1e-9


def test_with_mirrors_the_regressor_is_symmetric_and_no_worse():
    templates = subjects(8)
    truth = planted()
    joints = truth @ templates + 0.005 * np.random.default_rng(2).normal(size=(8, J, 3))
    found = fit_joint_regressor(templates, joints, mirror=MIRROR, joint_mirror=JOINT_MIRROR)
    assert np.array_equal(found, found[JOINT_MIRROR][:, MIRROR])
    assert (found >= 0).all() and np.abs(found.sum(1) - 1).max() < 1e-14
    assert held_out_error(found, truth) < held_out_error(
        fit_joint_regressor(templates, joints), truth
    )


def test_half_a_mirror_is_none():
    templates = subjects(4)
    joints = planted() @ templates + 0.01
    plain = fit_joint_regressor(templates, joints)
    assert np.array_equal(fit_joint_regressor(templates, joints, mirror=MIRROR), plain)
    assert np.array_equal(fit_joint_regressor(templates, joints, joint_mirror=JOINT_MIRROR), plain)


def test_only_candidates_get_weight():
    templates = subjects(30)
    truth = planted()
    candidates = truth > 0
    candidates[:, ::7] = True
    found = fit_joint_regressor(templates, truth @ templates, candidates=candidates, nearness=0.0)
    assert not found[~candidates].any() and np.abs(found - truth).max() < 1e-6


def test_of_equal_combinations_the_nearest_is_taken():
    templates = np.array(
        [[[0.1, 0, 0], [-0.1, 0, 0], [0.5, 0, 0], [-0.5, 0, 0], [0, 0.9, 0], [0, -0.9, 0]]]
    )
    found = fit_joint_regressor(templates, np.zeros((1, 1, 3)))
    assert np.allclose(found, [[0.5, 0.5, 0, 0, 0, 0]])


def deep(seed=1):
    """A regressor of weights below zero as well: no convex combination moves as it does."""
    rows = planted(seed) + 0.06 * np.random.default_rng(seed + 10).normal(size=(J, V))
    rows = (rows + rows[JOINT_MIRROR][:, MIRROR]) / 2
    return rows - (rows.sum(1, keepdims=True) - 1) / V


def people(count, seed=0, span=8):
    """Surfaces that vary in a few directions only, as people do."""
    ways = 0.03 * np.random.default_rng(50).normal(size=(span, V, 3))
    return subjects(1, variation=0.0) + np.tensordot(
        np.random.default_rng(seed).normal(size=(count, span)), ways, 1
    )


@pytest.mark.parametrize("mirrors", [{}, {"mirror": MIRROR, "joint_mirror": JOINT_MIRROR}])
@pytest.mark.parametrize("signs", ["auto", "signed"])
def test_joints_that_no_convex_combination_follows_are_followed_by_signed_ones(signs, mirrors):
    truth = deep()
    known = people(14)
    new = people(50, 9)

    def off(regressor):
        return np.linalg.norm((regressor - truth) @ new, axis=-1).mean()

    convex, found = (
        fit_joint_regressor(known, truth @ known, signs=each, **mirrors)
        for each in ("convex", signs)
    )
    assert off(found) < 0.35 * off(convex) and found.min() < 0
    assert np.abs(found.sum(1) - 1).max() < 1e-12
    if mirrors:
        assert np.allclose(found, found[JOINT_MIRROR][:, MIRROR], atol=1e-14)
    place = np.random.default_rng(3).normal(size=(14, 1, 3))
    moved = fit_joint_regressor(known + place, truth @ known + place, signs=signs, **mirrors)
    assert np.abs(moved - found).max() < 1e-8


def test_signs_are_free_only_where_they_pay():
    """Convex joints with noise stay convex, deep ones beside them do not."""
    known = people(14)
    truth = np.concatenate([planted()[:2], deep()[2:]])
    joints = truth @ known + 0.004 * np.random.default_rng(5).normal(size=(14, J, 3))
    convex, found = (
        fit_joint_regressor(known, joints, signs=signs) for signs in ("convex", "auto")
    )
    assert np.array_equal(convex[:2], found[:2])
    assert (found[2:].min(1) < 0).all()
    never = TrainSettings(regressor_gain=0.0)
    kept = fit_joint_regressor(known, joints, signs="auto", settings=never)
    assert np.array_equal(kept, convex)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_people_to_leave_some_out_give_convex_rows(count):
    templates = subjects(count)
    convex, found = (
        fit_joint_regressor(templates, planted() @ templates + 0.02, signs=s)
        for s in ("convex", "signed")
    )
    assert np.array_equal(convex, found)


@pytest.mark.wrong_shapes
@pytest.mark.parametrize(
    "change, said",
    [
        ({"joints": np.zeros((4, J, 3))}, "S subjects"),
        ({"signs": "some"}, "'some'; expected one of convex"),
        ({"templates": np.full((3, V, 3), np.nan)}, "not finite"),
        ({"candidates": np.ones((V, J), bool)}, "candidates"),
        ({"candidates": np.arange(J)[:, None] != np.full(V, 3)}, "joint 3 has no candidate"),
    ],
)
def test_what_does_not_fit_is_said(change, said):
    arguments = {"templates": subjects(3), "joints": np.zeros((3, J, 3))} | change
    with pytest.raises(HabitusError, match=said):
        fit_joint_regressor(**arguments)
