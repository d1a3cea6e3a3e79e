"""A capture file as a stream: its frames in order, at a rate, or as fast as they are asked for."""

import time

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.io.streams.open import Replay, open_source


@pytest.fixture
def path(tmp_path):
    markers = np.arange(360.0).reshape(20, 6, 3) + 1
    markers[4, 2] = 0.0
    np.savez(
        tmp_path / "walk.npz", markers=markers, labels=list("ABCDEF"), rate_hz=100.0, unit="mm"
    )
    return tmp_path / "walk.npz"


def test_frames_come_in_order_when_they_are_asked_for(path):
    source = Replay(path, 0)
    frames = []
    while not source.ended:
        frames += source.poll(0.0)
    assert [each.number for each in frames] == list(range(20)) and source.patient
    assert (
        np.isnan(frames[4].points[2]).all()
        and (frames[7].points == np.arange(126, 144).reshape(6, 3) + 1).all()
    )
    assert frames[0].heading.labels == tuple("ABCDEF") and frames[0].heading.rate_hz == 100.0
    assert source.poll(1.0) == []


def test_frames_are_due_at_their_rate_and_none_is_left_out_by_a_slow_reader(path):
    source = open_source("replay", path, 400.0)
    frames = []
    began = time.perf_counter()
    while not source.ended:
        frames += source.poll(0.05)
        time.sleep(0.008)
    assert 19 / 400 < time.perf_counter() - began < 1.0
    assert [each.number for each in frames] == list(range(20))
    np.testing.assert_allclose(np.diff([each.arrived for each in frames]), 1 / 400, atol=1e-9)


def test_what_is_no_capture_is_told(tmp_path):
    with pytest.raises(HabitusError, match="no such file"):
        open_source("replay", tmp_path / "none.c3d", None)
    with pytest.raises(HabitusError, match="no capture was given"):
        open_source("replay", None, None)
