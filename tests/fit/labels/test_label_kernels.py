"""Tracklets, soft shares and matches: laws that hold for any points."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from habitus.fit.labels.clouds import Clouds, packed, telling_frames, tracklets
from habitus.fit.labels.kernels import matched, soft_targets
from habitus.fit.labels.votes import assign


@pytest.mark.parametrize(("rows", "columns"), [(5, 9), (9, 5), (7, 7)])
def test_matches_are_as_cheap_as_scipys(rows, columns):
    cost = np.random.default_rng(rows).uniform(size=(rows, columns))
    out = np.empty(rows, dtype=np.int64)
    total = matched(cost, 0.7, out)
    clipped = np.minimum(cost, 0.7)
    assert total == pytest.approx(clipped[linear_sum_assignment(clipped)].sum())
    taken = out[out >= 0]
    assert (
        len(set(taken.tolist())) == len(taken)
        and (cost[np.flatnonzero(out >= 0), taken] < 0.7).all()
    )


def test_no_label_is_given_twice_in_a_frame_nor_above_its_gate():
    rng = np.random.default_rng(1)
    clouds = Clouds.of(rng.normal(size=(4, 6, 3)), 100.0, "+z")
    costs = rng.uniform(size=(24, 5))
    label = assign(costs, clouds, np.full(24, 0.5))
    for t in range(4):
        here = label[clouds.start[t] : clouds.start[t + 1]]
        assert len(set(here[here >= 0].tolist())) == (here >= 0).sum()
    named = label >= 0
    assert named.any() and (costs[named, label[named]] <= 0.5).all()


def test_what_points_give_is_never_more_than_they_are():
    rng = np.random.default_rng(2)
    clouds = Clouds.of(rng.normal(size=(1, 6, 3)), 100.0, "+z")
    predicted = rng.normal(size=(1, 8, 3))
    targets = np.empty((1, 8, 3))
    weights = np.empty((1, 8))
    soft_targets(
        predicted,
        clouds.points,
        clouds.start,
        np.zeros(1, dtype=np.int64),
        0.3,
        0.01,
        targets,
        weights,
    )
    assert weights.sum() <= 6.0 and (weights <= 1.0).all() and (weights >= 0.0).all()


def test_tracklets_follow_points_that_move_and_end_where_two_meet():
    seconds = np.arange(60) / 100.0
    still = np.zeros_like(seconds)
    one = np.stack([seconds - 0.3, still + 1e-3, still], axis=1)
    other = np.stack([0.3 - seconds, still - 1e-3, still], axis=1)
    away = np.stack([still + 2.0, seconds, still], axis=1)
    clouds = Clouds.of(np.stack([one, other, away], axis=1), 100.0, "+z")
    piece = tracklets(clouds).reshape(60, 3)
    assert len(np.unique(piece[:, 2])) == 1
    assert not set(piece[:25, 0]) & set(piece[:25, 1]) and not set(piece[35:, 0]) & set(
        piece[35:, 1]
    )
    assert not set(piece[:25, 0]) & set(piece[35:, 1])


def test_points_without_names_fill_few_columns_and_none_is_lost():
    markers = np.random.default_rng(3).normal(size=(9, 3, 3))
    markers[4:, 0] = markers[:5, 1] = np.nan
    clouds = Clouds.of(markers, 100.0, "+z")
    rest = packed(clouds, clouds.column, np.ones(len(clouds.points), dtype=bool))
    assert rest.shape == (9, 2, 3)
    assert np.array_equal(np.sort(rest[np.isfinite(rest)]), np.sort(clouds.points.ravel()))
    assert len(packed(clouds, clouds.column, np.zeros(len(clouds.points), dtype=bool))[0]) == 0


def test_telling_frames_are_full_and_spread():
    markers = np.ones((40, 4, 3))
    markers[::2, 0] = np.nan
    frames = telling_frames(Clouds.of(markers, 100.0, "+z"), 8)
    assert len(frames) == 8 and (frames % 2 == 1).all() and np.diff(frames).min() > 1
