"""Planted faults are found by name; clean data accuses nobody."""

import numpy as np
import pytest

from habitus.fit.markers.suspects import (
    crossed_placements,
    exchange_gains,
    far_placements,
    find_swaps,
    marker_noise,
    suspects,
    undo_swaps,
)

LABELS = tuple("ABCDEF")


@pytest.fixture
def predicted() -> np.ndarray:
    rng = np.random.default_rng(0)
    return 0.1 * rng.normal(size=(1, 6, 3)) + 0.5 * np.sin(np.linspace(0, 5, 200))[:, None, None]


def noisy(predicted: np.ndarray) -> np.ndarray:
    return predicted + 0.003 * np.random.default_rng(1).normal(size=predicted.shape)


def accuse(observed, predicted, swaps=(), drifts=()):
    return {
        s.label: s
        for s in suspects(LABELS, observed - predicted, np.full(6, 0.03), list(swaps), drifts)
    }


def test_clean_data_accuses_nobody(predicted):
    observed = noisy(predicted)
    assert not find_swaps(observed, predicted)
    assert not accuse(observed, predicted)


def test_noise_is_measured(predicted):
    noise = marker_noise(np.linalg.norm(noisy(predicted) - predicted, axis=2))
    np.testing.assert_allclose(noise, 0.003, rtol=0.15)


def test_noise_of_a_marker_that_lies_on_the_ground_is_what_it_was_before(predicted):
    observed = noisy(predicted)
    observed[80:, 2] += 0.7
    assert marker_noise(np.linalg.norm(observed - predicted, axis=2))[2] < 0.006


def test_what_grows_is_told_from_what_falls(predicted):
    observed = noisy(predicted)
    observed[60:, 1, 2] += np.linspace(0.0, 0.15, 140)
    observed[60:, 4, 2] -= np.minimum(np.linspace(0.0, 5.0, 140), 1.2)
    found = accuse(observed, predicted)
    assert (
        "drifted from frame" in found["B"].reason
        and "moved or fell from frame 6" in found["E"].reason
    )


def test_a_swap_is_found_in_its_frames_and_undone(predicted):
    clean = noisy(predicted)
    observed = clean.copy()
    observed[40:90, [1, 4]] = observed[40:90, [4, 1]]
    swaps = find_swaps(observed, predicted)
    assert [(i, j) for i, j, _ in swaps] == [(1, 4)]
    assert set(np.flatnonzero(swaps[0][2])) == set(range(40, 90))
    np.testing.assert_array_equal(undo_swaps(observed, swaps), clean)
    found = accuse(undo_swaps(observed, swaps), predicted, swaps)
    assert (
        set(found) == {"B", "E"}
        and found["B"].frames == 50
        and "swapped with E" in found["B"].reason
    )


def test_fallen_ghost_and_wrong_label_are_told_apart(predicted):
    observed = noisy(predicted)
    observed[120:, 0, 2] -= 0.5
    observed[50:60, 2] += 0.2
    observed[:, 3] += 0.3
    observed[:150, 5] = np.nan
    found = accuse(observed, predicted)
    assert set(found) == {"A", "C", "D"}
    assert (
        "from frame 120" in found["A"].reason
        and "ghost" in found["C"].reason
        and "wrong label" in found["D"].reason
    )


def test_latent_markers_at_each_others_places():
    start = np.random.default_rng(2).normal(size=(5, 3))
    latent = start + 0.01
    assert crossed_placements(latent, start) == ()
    latent[[1, 3]] = latent[[3, 1]]
    assert crossed_placements(latent, start) == ((1, 3),)


def test_gains_of_exchanges_are_what_exchanging_them_saves(predicted):
    predicted = np.broadcast_to(predicted, (200, 6, 3))
    observed = noisy(predicted)
    assert (exchange_gains(observed, predicted) < 0).all()
    observed[:, [1, 4]] = observed[:, [4, 1]]
    observed[:50, 1] = np.nan  # not seen
    observed[:, 5] = np.nan
    gains = exchange_gains(observed, predicted)
    away = np.linalg.norm(observed - predicted, axis=2)
    back = np.linalg.norm(observed[:, [4, 1]] - predicted[:, [1, 4]], axis=2)
    saved = (away[50:, 1] + away[50:, 4] - back[50:].sum(axis=1)).mean()
    np.testing.assert_allclose([gains[1, 4], gains[4, 1]], saved, rtol=1e-12)
    assert (gains > 0).sum() == 2
    assert np.isneginf(gains[5]).all() and np.isneginf(np.diagonal(gains)).all()


def test_a_pair_that_gains_less_than_half_is_no_exchange():
    """One marker fell, another slid to where that one was: exchanged they fit better, but neither
    fits well.
    """
    own = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    fallen = np.array([[0.35, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert crossed_placements(own[::-1], own) == ((0, 1),) and crossed_placements(fallen, own) == ()
    assert find_swaps(np.tile(own[::-1], (50, 1, 1)), np.tile(own, (50, 1, 1)))
    assert not find_swaps(np.tile(fallen, (50, 1, 1)), np.tile(own, (50, 1, 1)))


def test_latent_markers_far_from_their_places():
    start = np.random.default_rng(3).normal(size=(4, 3))
    away = np.array([0.1, 0.13, 0.3, 0.3])
    latent = start + away[:, None] * np.array([0.0, 0.6, 0.8])
    spread = np.array([0.01, 0.02, 0.02, 0.06])
    close = np.full((5, 4), 0.004)
    assert far_placements(latent, start, spread, close) == (1, 2)
    close[:, 0], close[:, 3] = 0.025, np.nan
    assert far_placements(latent, start, spread, close) == (0, 1, 2)


def test_a_marker_that_leaves_smoothly_is_no_ghost(predicted):
    """Skin and models err smoothly, by less than twice `GROSS`; a ghost comes and goes at once."""
    observed = noisy(predicted)
    hill = np.sin(np.linspace(0, np.pi, 40)) ** 2
    observed[30:70, 1, 2] += 0.07 * hill
    observed[100:140, 4, 2] += 0.2 * hill
    observed[150:, 5, 0] += 0.07
    assert set(accuse(observed, predicted)) == {"E", "F"}


def test_a_ghost_that_comes_twice_is_counted_twice(predicted):
    observed = noisy(predicted)
    observed[30:50, 2] += 0.3
    observed[120:150, 2] += 0.3
    assert accuse(observed, predicted)["C"].frames == 50


def test_a_few_bad_frames_of_many_are_no_suspicion(predicted):
    """Half a percent of the frames is less than what counts, however far off they are."""
    many = np.repeat(predicted, 10, axis=0)
    observed = noisy(many)
    observed[500:510, 2] += 0.5
    assert not accuse(observed, many)
    observed[500:560, 2] += 0.5
    assert set(accuse(observed, many)) == {"C"}


def test_what_was_put_back_is_told_apart_from_what_is_wrong(predicted):
    observed = noisy(predicted)
    observed[50:60, 2] += 0.2
    swap = (0, 1, np.arange(200) < 30)
    corrected = {"A": True, "B": True, "C": False, "F": False}
    found = accuse(observed, predicted, [swap], [(5, 0.05)])
    assert {label: suspect.corrected for label, suspect in found.items()} == corrected
    assert found["F"].reason.startswith("drift: slid 50 mm") and found["F"].frames == 200
