"""What is planted is what the names say, and nothing else changes."""

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus_lab.population import marker_faults as faults

T = 50
M = 5


@pytest.fixture
def markers() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(T, M, 3))


def changed(markers, spoilt) -> tuple[set[int], set[int]]:
    """Frames and markers that differ."""
    differs = ~np.isclose(markers, spoilt).all(axis=2)
    return set(np.flatnonzero(differs.any(axis=1))), set(np.flatnonzero(differs.any(axis=0)))


def test_a_swap_undoes_itself(markers):
    spoilt = faults.swapped(markers, 1, 3, slice(10, 20))
    assert changed(markers, spoilt) == (set(range(10, 20)), {1, 3})
    np.testing.assert_array_equal(faults.swapped(spoilt, 1, 3, slice(10, 20)), markers)


@pytest.mark.parametrize("up,axis,sign", [("+z", 2, 1), ("-y", 1, -1)])
def test_a_fallen_marker_falls_freely_and_stays_on_the_ground(markers, up, axis, sign):
    markers[:, 2] = 3.0 * sign
    spoilt = faults.fallen(markers, 2, 10, 100.0, up)
    assert changed(markers, spoilt)[1] == {2}
    height = sign * spoilt[:, 2, axis]
    assert height[9] == height[10] == 3.0 and np.isclose(height[20], 3.0 - 9.81 / 2 * 0.01)
    later = faults.fallen(np.repeat(markers, 4, axis=0), 2, 10, 100.0, up)
    assert np.isclose(sign * later[-1, 2, axis], (sign * markers[..., axis]).min())


def test_who_was_never_seen_cannot_fall(markers):
    markers[:20, 1] = np.nan
    with pytest.raises(HabitusError, match="not seen before"):
        faults.fallen(markers, 1, 10, 100.0)
    with pytest.raises(HabitusError, match="axis"):
        faults.fallen(markers, 1, 30, 100.0, "up")


def test_a_ghost_stands_still_beside_the_marker(markers):
    spoilt = faults.ghost(markers, 4, slice(5, 15), np.array([0.1, 0.0, 0.0]))
    assert changed(markers, spoilt) == (set(range(5, 15)), {4})
    np.testing.assert_allclose(
        spoilt[5:15, 4], np.broadcast_to(markers[5, 4] + (0.1, 0, 0), (10, 3))
    )


def test_a_wrong_label_sits_between_two_others(markers):
    spoilt = faults.wrong_label(markers, 0, (2, 4))
    np.testing.assert_allclose(spoilt[:, 0], (markers[:, 2] + markers[:, 4]) / 2)
    assert changed(markers, spoilt)[1] == {0}


def test_a_drift_grows_evenly_in_the_limbs_axes(markers):
    turns = np.linalg.qr(np.random.default_rng(1).normal(size=(T, 3, 3)))[0]
    moved = faults.drifting(markers, 3, turns, np.array([0.0, 0.06, 0.0])) - markers
    local = np.einsum("tji,tj->ti", turns, moved[:, 3])
    np.testing.assert_allclose(local, np.outer(np.linspace(0, 0.06, T), [0, 1, 0]), atol=1e-12)
    assert not moved[:, :3].any() and not moved[:, 4].any()


def test_losses_and_gaps(markers):
    many = np.repeat(markers, 40, axis=0)
    share = np.isnan(faults.lost(many, 0.2, np.random.default_rng(2))[..., 0]).mean()
    assert 0.18 < share < 0.22
    hidden = np.isnan(faults.gap(markers, np.array([0, 2]), slice(7, 9))[..., 0])
    assert hidden.sum() == 4 and hidden[7:9][:, [0, 2]].all()
