"""Frames for the shape stage: spread, complete, unchanged by how the body stands in the room."""

import numpy as np
import pytest

from habitus.fit.markers.recordings import random_frames, spread_frames
from habitus.fit.markers.settings import MoshSettings


@pytest.fixture
def observed() -> np.ndarray:
    rng = np.random.default_rng(0)
    base = rng.normal(size=(10, 3))
    swing = np.sin(np.linspace(0, 6, 300))[:, None, None] * rng.normal(size=(1, 10, 3))
    return base + swing


def test_the_shape_stage_takes_as_many_frames_as_the_paper():
    assert MoshSettings().frames == 12


@pytest.mark.parametrize("choose", [random_frames, spread_frames])
def test_as_many_as_asked_for_in_order_and_once_each(observed, choose):
    frames = choose(observed, 12, 0)
    assert len(frames) == 12 and (np.diff(frames) > 0).all()
    assert (choose(observed, 12, 0) == frames).all()


def test_turning_and_moving_the_body_changes_nothing(observed):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    moved = observed @ turn.T + np.random.default_rng(2).normal(size=(300, 1, 3))
    assert (spread_frames(moved, 12, 0) == spread_frames(observed, 12, 0)).all()


def test_spread_frames_reach_further_than_random_ones(observed):
    def reach(frames):
        return np.ptp(observed[frames], axis=0).sum()

    assert reach(spread_frames(observed, 6, 0)) > reach(random_frames(observed, 6, 0))


def test_incomplete_frames_are_left_out_but_every_marker_is_seen(observed):
    observed[::2, 1:4] = np.nan
    observed[:, 7] = np.nan
    observed[100:110, 7] = 0.0
    frames = spread_frames(observed, 8, 0)
    seen = np.isfinite(observed[frames][..., 0])
    assert seen[:, 7].sum() >= 3
    assert seen[:, 1].mean() > 0.5


def test_fewer_frames_than_asked_for():
    assert len(spread_frames(np.zeros((1, 5, 3)), 12, 0)) == 1
    assert len(random_frames(np.zeros((2, 5, 3)), 12, 0)) == 2


def test_random_frames_follow_the_seed_and_hold_a_marker(observed):
    observed[::3] = np.nan
    draws = [random_frames(observed, 12, seed) for seed in range(6)]
    assert len({tuple(frames) for frames in draws}) == 6
    assert all((frames % 3 > 0).all() for frames in draws)
    assert len(set(np.concatenate(draws))) > 50  # from all over the capture


def test_each_marker_is_seen_three_times_or_as_often_as_it_can_be(observed):
    """Markers that complete frames never show are fetched from others: the least complete half is
    looked at as well.
    """
    observed[:280, 4] = np.nan
    observed[1:, 6] = np.nan
    observed[280:, 0:3] = np.nan
    seen = np.isfinite(observed[spread_frames(observed, 5, 0)][..., 0]).sum(axis=0)
    assert seen[4] == 3 and seen[6] == 1 and seen[[0, 1, 2, 3, 5]].min() >= 3


def test_spread_frames_begin_in_the_middle_and_go_to_the_ends():
    """A marker that moves along a line: the median frame comes first, then the ends."""
    along = np.zeros((101, 6, 3))
    along[:, :, 1] = np.arange(6)
    along[:, 0, 0] = np.linspace(0.0, 4.0, 101) + 8.0
    assert list(spread_frames(along, 1, 0)) == [
        0,
        50,
        100,
    ]  # one chosen; two more, so that markers are seen three times
    assert list(spread_frames(along, 3, 0)) == [0, 50, 100]


def test_a_marker_hidden_for_a_frame_does_not_make_its_pose_odd(observed):
    """Unseen distances count as their median, not as zero, though the marker is far from all
    others.
    """
    observed[:, 7:] += 50.0
    observed[::2, 8], observed[1::2, 9] = np.nan, np.nan
    observed[141] = observed[143]
    observed[141, 7], observed[141, 9] = np.nan, observed[142, 9]
    assert 141 not in spread_frames(observed, 4, 0)
