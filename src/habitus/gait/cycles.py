"""Strides: from one strike of a foot to its next, their times and lengths, and curves over 101
points of a cycle.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.gait.events import FootEvents

POINTS = 101
"""Of a normalised cycle: 0 to 100 %."""
MIN_STRIDE, MAX_STRIDE = 0.4, 2.5
"""Seconds of a stride of somebody who walks or runs."""
MIN_LENGTH = 0.3
"""Metres that the heel goes in it."""
OTHER_STRIKE = (0.3, 0.7)
"""Shares of the cycle between which the other foot strikes."""
MIN_STRAIGHT = 0.9
"""Way of the pelvis from strike to strike, as a share of its horizontal path,"""
MAX_DIFFERENCE = 0.45
"""which differs from the heel's by no more than this share of it."""


@dataclass(frozen=True)
class Stride:
    """One cycle of a foot. start, off, end: foot strike, foot off and next strike (s).
    other_strike, other_off: of the other foot between them (s), None where there is none. length,
    step_length, step_width: m. double_support: share of the cycle.
    """

    side: str
    start: float
    off: float
    end: float
    other_strike: float | None
    other_off: float | None
    length: float
    step_length: float | None
    step_width: float | None
    double_support: float | None

    @property
    def seconds(self) -> float:
        """Strike to strike."""
        return self.end - self.start

    @property
    def speed(self) -> float:
        """m/s."""
        return self.length / self.seconds

    @property
    def cadence(self) -> float:
        """Steps a minute: two in a stride."""
        return 120.0 / self.seconds

    @property
    def stance(self) -> float:
        """Share of the cycle."""
        return (self.off - self.start) / self.seconds


def strides(
    events: Mapping[str, FootEvents],
    heels: Mapping[str, Float[np.ndarray, "T 3"]],
    pelvis: Float[np.ndarray, "T 3"],
    rate_hz: float,
    up: Float[np.ndarray, "3"],
) -> list[Stride]:
    """The strides of both feet, in order of time. heels, pelvis: m; up: the vertical.

    A stride has one foot off, the other foot strikes in its middle, and the pelvis goes straight
    and as far as the foot: steps of games, dances and turns on the spot are none.
    """
    out = []
    for side, own in events.items():
        other_side = "left" if side == "right" else "right"
        other = events.get(other_side, FootEvents(np.zeros(0), np.zeros(0)))
        for start, end in zip(own.strikes[:-1], own.strikes[1:], strict=True):
            offs = own.offs[(own.offs > start) & (own.offs < end)]
            if not MIN_STRIDE < end - start < MAX_STRIDE or len(offs) != 1:
                continue
            last = _at(heels[side], rate_hz, end)
            way = _flat(last - _at(heels[side], rate_hz, start), up)
            length = float(np.linalg.norm(way))
            strike = _first(other.strikes, start, end)
            if length < MIN_LENGTH or not _walks(pelvis, way, start, end, strike, rate_hz, up):
                continue
            off = _first(other.offs, start, end)
            step = width = None
            if strike is not None:
                from_other = _flat(last - _at(heels[other_side], rate_hz, strike), up)
                step = float(from_other @ way / length)
                width = float(abs(np.cross(way / length, from_other) @ up))
            out.append(
                Stride(
                    side,
                    float(start),
                    float(offs[0]),
                    float(end),
                    strike,
                    off,
                    length,
                    step,
                    width,
                    _double_support(start, float(offs[0]), end, strike, off),
                )
            )
    return sorted(out, key=lambda each: each.start)


def _walks(
    pelvis: Float[np.ndarray, "T 3"],
    way: Float[np.ndarray, "3"],
    start: float,
    end: float,
    other_strike: float | None,
    rate_hz: float,
    up: Float[np.ndarray, "3"],
) -> bool:
    """Whether a foot's way between two strikes is a stride's. Where the other foot's strike is not
    known, its time is no reason against it.
    """
    share = 0.5 if other_strike is None else (other_strike - start) / (end - start)
    path = pelvis[round(start * rate_hz) : round(end * rate_hz) + 1]
    flat = path - np.outer(path @ up, up)
    steps = np.linalg.norm(np.diff(flat, axis=0), axis=1).sum()
    own = flat[-1] - flat[0]
    difference = np.linalg.norm(own - way)
    return bool(
        OTHER_STRIKE[0] < share < OTHER_STRIKE[1]
        and np.linalg.norm(own) > MIN_STRAIGHT * steps
        and difference < MAX_DIFFERENCE * np.linalg.norm(way)
    )


def normalised(
    values: Float[np.ndarray, "S N"], rate_hz: float, start: float, end: float
) -> Float[np.ndarray, "101 N"]:
    """Curves between two times (s) at 0, 1, … 100 %, linearly between samples; NaN outside."""
    at = np.linspace(start, end, POINTS) * rate_hz
    rows = np.arange(len(values))
    columns = [np.interp(at, rows, column, np.nan, np.nan) for column in values.T]
    return np.stack(columns, 1)


def symmetry(left: Sequence[float], right: Sequence[float]) -> float | None:
    """Robinson's index: the difference of the sides' means over their mean (0: alike); positive
    where the right is larger. None without both.
    """
    if not len(left) or not len(right):
        return None
    one, other = float(np.mean(left)), float(np.mean(right))
    middle = 0.5 * (one + other)
    return (other - one) / middle if middle else 0.0


def _at(points: Float[np.ndarray, "T 3"], rate_hz: float, time: float) -> Float[np.ndarray, "3"]:
    """The frame nearest to a time (s)."""
    return points[min(len(points) - 1, round(time * rate_hz))]


def _flat(way: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return way - (way @ up) * up


def _first(times: Float[np.ndarray, " n"], start: float, end: float) -> float | None:
    inside = times[(times > start) & (times < end)]
    return float(inside[0]) if len(inside) else None


def _double_support(
    start: float, off: float, end: float, other_strike: float | None, other_off: float | None
) -> float | None:
    """Share of the cycle in which both feet stand: up to the other's off, and from its strike on to
    the own off; 0 where there is flight.
    """
    if other_strike is None or other_off is None or other_off > other_strike:
        return None
    return (max(0.0, other_off - start) + max(0.0, off - other_strike)) / (end - start)
