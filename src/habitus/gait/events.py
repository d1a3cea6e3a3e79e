"""Foot strikes and foot offs from the motion of the foot.

A swing is a time in which the tip of the toes moves fast; it begins at foot off. It ends at foot
strike, where the heel has come to rest. Constants are from eight contacts on force plates
(docs/for-laboratories.md); plates and a file's own events are better where there are such.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.arrays import runs

CUTOFF_HZ = 12.0
"""Of the feet's low-pass filter, forwards and backwards, of second order."""
OFF_SPEED = 0.6
"""m/s of the tip of the toes, above which the foot has left the floor."""
STRIKE_SPEED = 0.3
"""m/s of the heel, below which the foot is on the floor."""
SWING_SPEED = 1.2
"""m/s that the tip of the toes reaches in a swing,"""
MIN_SWING = 0.12
"""which lasts this long (s) at least, as"""
MIN_STANCE = 0.1
"""a stance does."""
MIN_STEP = 0.25
"""Metres that the heel goes in a swing of somebody who walks; less is stepping on the spot."""


@dataclass(frozen=True, eq=False)
class FootEvents:
    """One foot's strikes and offs (s from the first frame, in order). source: "file", "plates" or
    "motion".
    """

    strikes: Float[np.ndarray, " n"]
    offs: Float[np.ndarray, " m"]
    source: str = "motion"


def motion_events(
    heel: Float[np.ndarray, "T 3"], toe: Float[np.ndarray, "T 3"], rate_hz: float
) -> FootEvents:
    """Events of one foot from its heel and the tip of its toes (m). Nothing where the foot makes
    no step.
    """
    if len(heel) < max(8, round(0.3 * rate_hz)):
        return FootEvents(np.zeros(0), np.zeros(0))
    smooth = lowpass(np.stack([heel, toe], 1), rate_hz, CUTOFF_HZ)
    heel_speed, toe_speed = np.linalg.norm(np.gradient(smooth, axis=0) * rate_hz, axis=-1).T
    strikes, offs = [], []
    for first, last in _swings(toe_speed, rate_hz):
        end = _crossing(heel_speed, STRIKE_SPEED, first + toe_speed[first:last].argmax())
        rows = slice(first, last if end is None else int(end) + 1)
        if np.linalg.norm(smooth[rows, 0][-1] - smooth[first, 0]) < MIN_STEP:
            continue
        if first > 0:
            offs.append(_between(toe_speed, OFF_SPEED, first - 1) / rate_hz)
        if end is not None:
            strikes.append(end / rate_hz)
    return FootEvents(np.array(strikes), np.array(offs))


def lowpass(
    values: Float[np.ndarray, "T *any"], rate_hz: float, cutoff_hz: float
) -> Float[np.ndarray, "T *any"]:
    """A Butterworth filter of second order, forwards and backwards, whose gain is half at the
    cut-off; values as they are where the rate is too low or the motion too short for it.
    """
    corner = cutoff_hz / (np.sqrt(2.0) - 1.0) ** 0.25 / (0.5 * rate_hz)
    if corner >= 0.95 or len(values) <= 12:
        return values
    from scipy.signal import butter, sosfiltfilt  # half a second, with all of scipy.stats

    return sosfiltfilt(np.asarray(butter(2, corner, output="sos")), values, axis=0)


def _swings(toe_speed: Float[np.ndarray, " T"], rate_hz: float) -> list[tuple[int, int]]:
    """First frame and end of each swing; swings with a shorter stance between are one."""
    fast = toe_speed > OFF_SPEED
    swings: list[tuple[int, int]] = []
    for first, last in runs(fast):
        if swings and first - swings[-1][1] < MIN_STANCE * rate_hz:
            swings[-1] = (swings[-1][0], last)
        else:
            swings.append((first, last))
    return [
        (first, last)
        for first, last in swings
        if toe_speed[first:last].max() > SWING_SPEED and last - first >= MIN_SWING * rate_hz
    ]


def _crossing(speed: Float[np.ndarray, " T"], limit: float, first: int) -> float | None:
    """The frame, with its fraction, from ``first`` on at which a speed falls below a limit."""
    slow = np.flatnonzero(speed[first:] < limit)
    if not len(slow) or first + slow[0] == 0:
        return None
    return _between(speed, limit, first + int(slow[0]) - 1)


def _between(speed: Float[np.ndarray, " T"], limit: float, row: int) -> float:
    """Where a speed crosses a limit between a frame and the next."""
    one, other = speed[row] - limit, speed[row + 1] - limit
    return row + (one / (one - other) if one != other else 0.5)
