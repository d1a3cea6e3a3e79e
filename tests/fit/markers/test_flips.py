"""Labels that change places from one frame to the next are put back before anything is fitted."""

import time

import numpy as np
import pytest

from habitus.fit.markers.suspects import find_flips, undo_swaps
from habitus_lab.population.marker_faults import lost, swapped

T = 200


@pytest.fixture
def markers() -> np.ndarray:
    """Six markers 8 cm apart that swing together at up to 5 m/s, 100 Hz, a millimetre of noise."""
    rng = np.random.default_rng(0)
    seconds = np.arange(T) / 100.0
    swing = np.stack([np.sin(8 * seconds), 0.6 * np.cos(7 * seconds), 0.1 * seconds], axis=1)
    places = 0.08 * np.stack([np.arange(6), np.arange(6) % 2, np.zeros(6)], axis=1)
    return swing[:, None] + places + 1e-3 * rng.normal(size=(T, 6, 3))


def flips_of(markers):
    return {(i, j): set(np.flatnonzero(frames)) for i, j, frames in find_flips(markers)}


def test_clean_markers_are_left_alone(markers):
    assert flips_of(markers) == {}
    assert flips_of(lost(markers, 0.3, np.random.default_rng(1))) == {}
    assert flips_of(markers[:2]) == {}


@pytest.mark.parametrize("frames", [slice(40, 90), slice(150, T), slice(0, 60), slice(100, 104)])
def test_a_pair_is_put_back_in_its_frames(markers, frames):
    spoilt = swapped(markers, 1, 4, frames)
    assert flips_of(spoilt) == {(1, 4): set(range(*frames.indices(T)))}
    np.testing.assert_array_equal(undo_swaps(spoilt, find_flips(spoilt)), markers)


def test_the_smaller_part_is_the_wrong_one(markers):
    assert flips_of(swapped(markers, 0, 3, slice(30, 180))) == {
        (0, 3): {*range(30), *range(180, T)}
    }


def test_several_pairs_and_several_times(markers):
    spoilt = swapped(
        swapped(swapped(markers, 0, 1, slice(20, 40)), 2, 5, slice(30, 60)), 0, 1, slice(100, 130)
    )
    assert flips_of(spoilt) == {
        (0, 1): {*range(20, 40), *range(100, 130)},
        (2, 5): set(range(30, 60)),
    }
    np.testing.assert_array_equal(undo_swaps(spoilt, find_flips(spoilt)), markers)


def test_one_of_five_samples_lost_hides_little(markers):
    spoilt = lost(swapped(markers, 1, 4, slice(60, 120)), 0.2, np.random.default_rng(2))
    got = flips_of(spoilt)
    assert set(got) == {(1, 4)} and len(got[1, 4] ^ set(range(60, 120))) <= 6


def test_a_ghost_is_no_exchange(markers):
    markers[50:60, 2] += 0.2
    assert flips_of(markers) == {}


def test_frames_in_random_order_hold_no_exchange_and_take_no_time(markers):
    """Every sample jumps then: pairs of them would be looked for among 60 markers for minutes."""
    many = np.tile(markers, (20, 10, 1)) + np.random.default_rng(1).normal(size=(60, 3))
    began = time.process_time()
    assert flips_of(many[np.random.default_rng(0).permutation(len(many))]) == {}
    assert time.process_time() - began < 20.0
