"""Frames for the shape stage: spread, complete, unchanged by how the body stands in the room."""

import numpy as np
import pytest

from habitus.fit.mosh.frames import random_frames, spread_frames


@pytest.fixture
def observed() -> np.ndarray:
    rng = np.random.default_rng(0)
    base = rng.normal(size=(10, 3))
    swing = np.sin(np.linspace(0, 6, 300))[:, None, None] * rng.normal(size=(1, 10, 3))
    return base + swing


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
