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
MAX_STRIDE = 3.0
"""Seconds: longer is no stride."""
MIN_LENGTH = 0.3
"""Metres that the heel goes in a stride of somebody who walks."""


@dataclass(frozen=True)
class Stride:
    """One cycle of a foot. side; start, off, end: strike, foot off and next strike (s); other: the
    other foot's strike and off between, None where there are none. length, step_length and
    step_width in m; speed in m/s; cadence in steps a minute; stance and double_support as shares of
    the cycle.
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
    rate_hz: float,
    up: Float[np.ndarray, "3"],
) -> list[Stride]:
    """The strides of both feet, in order of time. heels: m; up: the vertical.

    A stride lasts `MAX_STRIDE` at most, its foot goes `MIN_LENGTH`, and has one off between.
    """
    out = []
    for side, own in events.items():
        other_side = "left" if side == "right" else "right"
        other = events.get(other_side, FootEvents(np.zeros(0), np.zeros(0)))
        for start, end in zip(own.strikes[:-1], own.strikes[1:], strict=True):
            offs = own.offs[(own.offs > start) & (own.offs < end)]
            if end - start > MAX_STRIDE or len(offs) != 1:
                continue
            at = {s: _at(points, rate_hz) for s, points in heels.items()}
            way = _flat(at[side](end) - at[side](start), up)
            length = float(np.linalg.norm(way))
            if length < MIN_LENGTH:
                continue
            strike = _first(other.strikes, start, end)
            off = _first(other.offs, start, end)
            step = width = None
            if strike is not None:
                from_other = _flat(at[side](end) - at[other_side](strike), up)
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
    return (other - one) / (0.5 * (one + other))


def _at(points: Float[np.ndarray, "T 3"], rate_hz: float):
    return lambda t: points[min(len(points) - 1, round(t * rate_hz))]


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
