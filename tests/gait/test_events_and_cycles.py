"""Made feet that walk: their strikes and offs, strides, and contacts with plates are found."""

import numpy as np
import pytest

from habitus.gait.contacts import ForcePlate, find_contacts
from habitus.gait.cycles import normalised, strides, symmetry
from habitus.gait.events import FootEvents, lowpass, motion_events

RATE = 100.0
UP = np.array([0.0, 0.0, 1.0])


def eased(t: np.ndarray) -> np.ndarray:
    """From 0 to 1 with the speed and acceleration of a swing."""
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t * t)


def walk(
    seconds: float = 6.0,
    stride: float = 1.2,
    length: float = 1.4,
    stance: float = 0.62,
    rate: float = RATE,
) -> tuple[dict, dict, dict, np.ndarray]:
    """Heels and tips of toes of two feet, true strikes and offs (s), and the pelvis' path (m)."""
    t = np.arange(round(seconds * rate)) / rate
    heels, toes, truth = {}, {}, {}
    for side, phase in (("left", 0.0), ("right", 0.5)):
        cycle = t / stride + phase
        number, share = np.floor(cycle), cycle % 1.0
        swing = eased((share - stance) / (1.0 - stance))
        lift = 0.12 * np.sin(np.pi * np.clip((share - stance) / (1.0 - stance), 0, 1)) ** 2
        ahead = length * (number + swing - phase)
        y = 0.08 if side == "left" else -0.08
        heels[side] = np.stack([ahead, np.full(len(t), y), lift], 1)
        toes[side] = heels[side] + [0.24, 0.0, 0.0]
        cycles = np.arange(0, int(seconds / stride) + 2) - phase
        strikes, offs = stride * cycles, stride * (cycles + stance)
        truth[side] = FootEvents(
            strikes[(strikes > 0.1) & (strikes < seconds - 0.1)],
            offs[(offs > 0.1) & (offs < seconds - 0.3)],
        )
    pelvis = np.stack([length * t / stride, 0 * t, 0.9 + 0 * t], 1)
    return heels, toes, truth, pelvis


@pytest.mark.parametrize("rate", [60.0, 100.0, 250.0])
@pytest.mark.parametrize(("stride", "length"), [(1.0, 1.5), (1.3, 1.0), (0.9, 0.8)])
def test_strikes_and_offs_are_found(rate, stride, length):
    heels, toes, truth, _ = walk(stride=stride, length=length, rate=rate)
    for side in heels:
        found = motion_events(heels[side], toes[side], rate)
        for name, late in (("strikes", 0.06), ("offs", 0.06)):
            own, true = getattr(found, name), getattr(truth[side], name)
            off = own[:, None] - true
            nearest = off[np.abs(off).argmin(0), np.arange(len(true))]
            assert np.abs(nearest).max() < late, name
            assert np.std(nearest) < 0.008
            assert len(own) <= len(true) + 2


def test_who_stands_or_steps_on_the_spot_makes_no_event():
    rng = np.random.default_rng(0)
    t = np.arange(600) / RATE
    still = np.tile([0.0, 0.1, 0.0], (600, 1)) + 0.001 * rng.normal(size=(600, 3))
    stepping = still + 0.15 * np.maximum(0.0, np.sin(2 * np.pi * t))[:, None] ** 2 * [0.0, 0.0, 1.0]
    for heel in (still, stepping, still[:5]):
        found = motion_events(heel, heel + np.array([0.24, 0, 0]), RATE)
        assert not len(found.strikes) and not len(found.offs)


def test_strides_have_the_numbers_of_the_walk():
    heels, _, truth, pelvis = walk()
    found = strides(truth, heels, pelvis, RATE, UP)
    assert len(found) >= 6
    for stride in found:
        assert abs(stride.seconds - 1.2) < 1e-9 and abs(stride.length - 1.4) < 0.01
        assert abs(stride.speed - 1.4 / 1.2) < 0.01 and abs(stride.cadence - 100.0) < 1e-6
        assert abs(stride.stance - 0.62) < 1e-9
        assert abs(stride.step_length - 0.7) < 0.01 and abs(stride.step_width - 0.16) < 1e-3
        assert abs(stride.double_support - 0.24) < 1e-9


def test_turns_on_the_spot_and_steps_without_the_other_foot_are_no_strides():
    heels, _, truth, pelvis = walk()
    around = pelvis.copy()
    angle = np.linspace(0, 12 * np.pi, len(pelvis))
    around[:, 0], around[:, 1] = 0.3 * np.cos(angle), 0.3 * np.sin(angle)
    assert not strides(truth, heels, around, RATE, UP)
    late = {
        "left": truth["left"],
        "right": FootEvents(truth["left"].strikes + 0.05, truth["left"].offs),
    }
    assert not [s for s in strides(late, heels, pelvis, RATE, UP) if s.side == "left"]
    assert not strides({}, heels, pelvis, RATE, UP)


def test_cycles_are_resampled_where_they_are():
    values = np.stack([np.arange(200.0), np.arange(200.0) ** 2], 1)
    curve = normalised(values, RATE, 0.2, 1.2)
    np.testing.assert_allclose(curve[:, 0], np.linspace(20.0, 120.0, 101))
    np.testing.assert_allclose(curve[[0, 50, 100], 1], [400.0, 4900.0, 14400.0])
    assert np.isnan(normalised(values, RATE, 1.5, 2.5)[-1]).all()
    assert symmetry([1.0, 1.0], [1.0]) == 0.0 and symmetry([], [1.0]) is None
    assert abs(symmetry([0.9], [1.1]) - 0.2) < 1e-12


def test_the_filter_passes_half_at_its_cut_off():
    t = np.arange(2000) / RATE
    wave = np.sin(2 * np.pi * 6.0 * t)[:, None]
    gain = np.abs(lowpass(wave, RATE, 6.0))[500:1500].max()
    assert abs(gain - 0.7071) < 0.02  # of both passes together
    np.testing.assert_array_equal(lowpass(wave, RATE, 60.0), wave)


CORNERS = np.array([[0.5, 0.4, 0], [0.0, 0.4, 0], [0.0, 0.0, 0], [0.5, 0.0, 0]])


def step_on(shift: np.ndarray, other: np.ndarray | None = None) -> list:
    """Contacts of a left foot, 26 cm long along x, that stands ``shift`` (m) from the plate's
    middle; the right one in the air, or standing at ``other``.
    """
    count, each = 100, 10
    sole = np.array(
        [
            [0.0, 0.0, 0],
            [0.26, 0.0, 0],
            [0.25, 0.02, 0],
            [0.19, 0.04, 0],
            [0.2, 0.0, 0],
            [0.17, -0.04, 0],
        ]
    )
    middle = CORNERS.mean(0)
    feet = {"left": np.tile(sole + middle - [0.13, 0, 0] + shift, (count, 1, 1))}
    away = (
        np.linspace(-1, 1, count)[:, None, None] * [2.0, 0, 0] + [0, 0.2, 0.15]
        if other is None
        else 0.0
    )
    feet["right"] = (
        np.tile(sole + middle - [0.13, 0, 0] + (0 if other is None else other), (count, 1, 1))
        + away
    )
    size = 700.0 * np.sin(np.linspace(-0.5, np.pi + 0.5, count * each)).clip(0.0)
    force = size[:, None] * UP
    pressure = np.where(
        size[:, None] > 20,
        middle + shift + np.linspace(-0.1, 0.1, count * each)[:, None] * [1, 0, 0],
        np.nan,
    )
    plate = ForcePlate(1, CORNERS, force, pressure, np.zeros_like(force), RATE * each)
    return find_contacts([plate], feet, RATE)


def test_made_partial_hits_are_found():
    """Feet anywhere on and beside a plate: refused where 3 cm or more of the sole lie outside it; of
    those that lie inside by a centimetre, none.
    """
    rng = np.random.default_rng(1)
    missed = wrong = partial = whole = 0
    for _ in range(200):
        shift = rng.uniform([-0.25, -0.2, 0.0], [0.25, 0.2, 0.0])
        outside = max(abs(shift[0]) + 0.13 - 0.25, abs(shift[1]) + 0.04 - 0.2)
        (contact,) = step_on(shift)
        assert contact.side == "left"
        if outside > 0.03:
            partial += 1
            missed += not contact.refused
        elif outside < -0.01:
            whole += 1
            wrong += bool(contact.refused)
    assert partial > 40 and whole > 30
    assert missed == 0 and wrong == 0


def test_two_feet_on_one_plate_and_nobody_are_refused():
    (contact,) = step_on(np.array([0.0, 0.08, 0.0]), np.array([0.0, -0.1, 0.0]))
    assert contact.side == "left" and contact.refused == "both feet stand on the plate"
    (contact,) = step_on(np.array([0.0, 0.08, 0.0]), np.array([0.0, -0.6, 0.0]))
    assert not contact.refused
    count = 100
    far = {side: np.tile([3.0, 0.0, 0.0], (count, 6, 1)) for side in ("left", "right")}
    force = np.tile(600.0 * UP, (count, 1))
    plate = ForcePlate(2, CORNERS, force, np.tile(CORNERS.mean(0), (count, 1)), 0 * force, RATE)
    (contact,) = find_contacts([plate], far, RATE)
    assert contact.side == "" and "no foot" in contact.refused
    assert contact.start is None and contact.end is None
    knock = ForcePlate(
        3, CORNERS, 0.1 * force, np.tile(CORNERS.mean(0), (count, 1)), 0 * force, RATE
    )
    assert not find_contacts([knock], far, RATE)
