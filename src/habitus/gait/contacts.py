"""Which foot is on which force plate, and from when to when."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from habitus.arrays import runs

MIN_CONTACT = 0.1
"""Seconds, and"""
MIN_PEAK = 150.0
"""newtons of a contact; shorter and weaker ones are knocks."""
MAX_DISTANCE = 0.12
"""Metres of the centre of pressure from a foot that is on the plate."""
NEAR_SURFACE = 0.025
"""Metres above a plate, below which a point of the sole stands on it."""
MAX_BESIDE = 0.015
"""Metres by which the sole may reach beyond the plate's edge: the fit's own error."""
MAX_SPEED = 0.3
"""m/s of a point that stands."""
MIN_SHARE = 0.2
"""Of a contact's frames, in which a second foot on the plate, or a sole beside it, is no chance."""


@dataclass(frozen=True)
class Contact:
    """A load on one plate. side: "left", "right", or "" for nobody whom the fit shows. start, end:
    s from the first frame, None where the recording begins or ends in it. distance: of the centre
    of pressure from the foot, weighed by the force (m). refused: why its forces are not used, empty
    where they are.
    """

    plate: int
    side: str
    start: float | None
    end: float | None
    distance: float
    refused: str = ""

    @property
    def span(self) -> tuple[float, float]:
        """From when to when (s); the whole recording where its ends are not known."""
        return self.start or 0.0, float("inf") if self.end is None else self.end


@dataclass(frozen=True, eq=False)
class ForcePlate:
    """A force plate in the world of the points. corners (4, 3): in order around the plate, m. force
    (S, 3): on the person, N. pressure (S, 3): centre of pressure in the plate's plane, m, NaN where
    the plate is not loaded. free_moment (S, 3): about the plate's normal there, Nm. kind: its type
    in C3D files.
    """

    number: int
    corners: Float[np.ndarray, "4 3"]
    force: Float[np.ndarray, "S 3"]
    pressure: Float[np.ndarray, "S 3"]
    free_moment: Float[np.ndarray, "S 3"]
    rate_hz: float
    kind: int = 0
    notes: tuple[str, ...] = ()

    @property
    def loaded(self) -> Bool[np.ndarray, " S"]:
        """Samples that have a centre of pressure."""
        return np.isfinite(self.pressure[:, 0])


def find_contacts(
    plates: Sequence[ForcePlate],
    feet: Mapping[str, Float[np.ndarray, "T P 3"]],
    rate_hz: float,
) -> list[Contact]:
    """The loads on all plates. feet: points of the sole of each foot ("left", "right"; m)."""
    out = []
    for plate in plates:
        for first, last in runs(plate.loaded):
            size = np.linalg.norm(plate.force[first:last], axis=1)
            if last - first >= MIN_CONTACT * plate.rate_hz and size.max() >= MIN_PEAK:
                out.append(_contact(plate, first, last, feet, rate_hz))
    return sorted(out, key=lambda each: (each.start or 0.0, each.plate))


def _contact(
    plate: ForcePlate,
    first: int,
    last: int,
    feet: Mapping[str, Float[np.ndarray, "T P 3"]],
    rate_hz: float,
) -> Contact:
    frames = np.round(np.arange(first, last) * rate_hz / plate.rate_hz).astype(int)
    inside = frames < min(len(points) for points in feet.values())
    rows = np.arange(first, last)[inside]
    weight = np.linalg.norm(plate.force[rows], axis=1)
    away = {
        side: np.linalg.norm(points[frames[inside]] - plate.pressure[rows][:, None], axis=-1).min(1)
        for side, points in feet.items()
    }
    start = first / plate.rate_hz if first > 0 else None
    end = last / plate.rate_hz if last < len(plate.force) else None
    if not len(rows):
        return Contact(plate.number, "", start, end, float("inf"), "after the last frame")
    mean = {side: float(np.average(off, weights=weight)) for side, off in away.items()}
    side = min(mean, key=lambda each: mean[each])
    if mean[side] > MAX_DISTANCE:
        why = f"no foot is within {100 * MAX_DISTANCE:.0f} cm of the centre of pressure"
        return Contact(plate.number, "", start, end, mean[side], why)
    strong = frames[inside][weight > 0.5 * weight.max()]
    other = "left" if side == "right" else "right"
    why = ""
    beside = _beside(plate, feet[side][strong])
    if (beside > MAX_BESIDE).mean() > MIN_SHARE:
        reach = 100.0 * float(np.median(beside[beside > MAX_BESIDE]))
        why = f"the foot stands {reach:.0f} cm beyond the plate's edge"
    elif _standing_on(plate, feet[other], rate_hz)[strong].mean() > MIN_SHARE:
        why = "both feet stand on the plate"
    return Contact(plate.number, side, start, end, mean[side], why)


def _outside(
    plate: ForcePlate, points: Float[np.ndarray, "n P 3"]
) -> tuple[Float[np.ndarray, "n P"], Float[np.ndarray, "n P"]]:
    """How far points lie outside the plate's edges (m, below zero inside), and above its plane."""
    middle = plate.corners.mean(0)
    normal = np.cross(plate.corners[1] - plate.corners[0], plate.corners[3] - plate.corners[0])
    normal /= np.linalg.norm(normal)
    off = np.full(points.shape[:-1], -np.inf)
    for one, other in zip(plate.corners, np.roll(plate.corners, -1, axis=0), strict=True):
        out = np.cross(other - one, normal)
        out /= np.linalg.norm(out)
        out *= np.sign(out @ (one - middle))
        off = np.maximum(off, (points - one) @ out)
    return off, np.abs((points - middle) @ normal)


def _beside(plate: ForcePlate, sole: Float[np.ndarray, "n P 3"]) -> Float[np.ndarray, " n"]:
    """How far (m) the part of a sole that is on the floor reaches beyond the plate."""
    off, height = _outside(plate, sole)
    return np.where(height < NEAR_SURFACE, off, -np.inf).max(1, initial=-np.inf)


def _standing_on(
    plate: ForcePlate, sole: Float[np.ndarray, "T P 3"], rate_hz: float
) -> Bool[np.ndarray, " T"]:
    """Whether a point of a sole stands on the plate."""
    off, height = _outside(plate, sole)
    speed = np.linalg.norm(np.gradient(sole, axis=0) * rate_hz, axis=-1)
    return ((height < NEAR_SURFACE) & (off < -MAX_BESIDE) & (speed < MAX_SPEED)).any(1)
