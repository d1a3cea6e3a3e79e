"""What is looked for in whole captures comes out bit for bit the same where arrays lie over
files.
"""

import numpy as np
import pytest
from marker_scene import scene

from habitus.fit.markers.gaps import bridged, fill_short_gaps, without
from habitus.fit.markers.recordings import Recording, without_outliers
from habitus.fit.markers.suspects import find_flips, marker_noise, suspects
from habitus.observe.marker_prediction import predict
from habitus.parallel import blocks

LABELS = tuple(f"M{k:02}" for k in range(25))


@pytest.fixture(scope="module")
def gappy():
    """Short gaps, a long one, an empty stretch, two labels exchanged for a time, a marker that
    falls.
    """
    s = scene(frames=400, noise=0.002, seed=4)
    s.observed[90:120, [3, 11]] = s.observed[90:120, [11, 3]]
    s.observed[s.rng.random(s.observed.shape[:2]) < 0.05] = np.nan
    s.observed[150:200, :8] = s.observed[260:280] = np.nan
    s.observed[300:, 5] += 0.5
    s.observed[40, 7] = 1e4
    return s


@pytest.fixture
def both(monkeypatch):
    """What a function gives with plenty of memory, and with hardly any."""

    def call(function):
        plenty = function()
        monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
        monkeypatch.setattr(blocks, "BLOCK", 32)
        return plenty, function()

    return call


def test_short_gaps_are_filled(gappy, both):
    plenty, short = both(lambda: fill_short_gaps(gappy.observed, 100.0))
    np.testing.assert_array_equal(short, plenty)
    assert (
        blocks.is_file_backed(short)
        and np.isfinite(plenty).sum() > np.isfinite(gappy.observed).sum()
    )


def test_long_gaps_are_bridged(gappy, both):
    def bridge():
        evidence, pose, trans = bridged(gappy.rig, gappy.pose, gappy.trans, gappy.observed, 100.0)
        return *without(evidence, [2]), pose, trans

    for plenty, short in zip(*both(bridge), strict=True):
        np.testing.assert_array_equal(short, plenty)


def test_flips_are_found(gappy, both):
    plenty, short = both(lambda: find_flips(gappy.observed))
    assert [flip[:2] for flip in short] == [flip[:2] for flip in plenty]
    for one, other in zip(plenty, short, strict=True):
        np.testing.assert_array_equal(one[2], other[2])


def test_samples_out_of_reach_are_left_out(gappy, both):
    plenty, short = both(
        lambda: without_outliers(Recording("gappy", gappy.observed, 100.0), LABELS)
    )
    np.testing.assert_array_equal(short.observed, plenty.observed)
    assert short.suspects == plenty.suspects and [one.label for one in plenty.suspects] == ["M07"]


def test_suspects_and_noise_are_told(gappy, both):
    off = gappy.observed - predict(gappy.rig, gappy.pose, gappy.trans)
    scale = np.full(25, 0.1)
    way = np.linalg.norm(off, axis=2)
    plenty, short = both(lambda: (suspects(LABELS, off, scale, []), marker_noise(way)))
    assert short[0] == plenty[0] and "M05" in [one.label for one in plenty[0]]
    np.testing.assert_array_equal(short[1], plenty[1])
