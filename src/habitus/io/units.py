"""Metres and axes, whatever the file says: its claims are checked against the body that its numbers
make.

Unit: read, then checked against the size of the body. Up: in most frames of most captures the head
is above the feet; for a person who lies throughout the floor decides, which is where a capture's
heights begin. Handedness needs no world at all: on a body, front x left points to the head, lying
or not; in a mirrored capture it points to the feet.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.markers.labels import Place, place_of

METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
_WORDS = {
    "m": "m meter meters metre metres",
    "dm": "dm decimeter decimeters decimetre decimetres",
    "cm": "cm centimeter centimeters centimetre centimetres",
    "mm": "mm millimeter millimeters millimetre millimetres",
    "um": "um µm micrometer micrometers micrometre micrometres",
    "in": "in inch inches",
    "ft": "ft foot feet",
}
_UNIT_OF = {word: unit for unit, words in _WORDS.items() for word in words.split()}
_MAX_FRAMES = 200
_USUAL_M = 1.6


def unit_of(text: str | None) -> str | None:
    """The unit a file's word stands for: "Millimeters" -> "mm"; None where it is no unit of
    length.
    """
    return _UNIT_OF.get(text.strip().lower()) if text else None


def extent(points: Float[np.ndarray, "T M 3"]) -> float:
    """The size of the body in the points' unit: twice the distance from the middle that holds nine
    in ten points.
    """
    seen = np.isfinite(points[..., 0]).sum(axis=1)
    if not seen.any():
        return float("nan")
    frames = np.flatnonzero(seen >= max(1, seen.max() // 2))
    chosen = points[frames[:: max(1, len(frames) // _MAX_FRAMES)]]
    chosen = chosen[:, np.isfinite(chosen[..., 0]).any(axis=0)]
    distance = np.linalg.norm(chosen - np.nanmedian(chosen, axis=1, keepdims=True), axis=2)
    return float(2 * np.median(np.nanpercentile(distance, 90, axis=1)))


def restlessness(points: Float[np.ndarray, "T M 3"]) -> float:
    """How far a point moves against the others from frame to frame, at the median, as a share of
    the body's extent.
    """
    steps = np.arange(len(points) - 1)[:: max(1, len(points) // _MAX_FRAMES)]
    both = np.stack([points[steps], points[steps + 1]])
    shared = np.isfinite(both).all(axis=(0, 3))
    both = both[:, shared.sum(axis=1) >= 4]
    if both.shape[1] < 8:
        return 0.0
    both = both[:, :, shared.any(axis=0)]
    both = both - np.nanmean(both, axis=2, keepdims=True)
    return float(np.nanmedian(np.linalg.norm(both[1] - both[0], axis=2)) / extent(points))


def find_unit(
    labels: Sequence[str], points: Float[np.ndarray, "T M 3"], claim: str | None
) -> tuple[str, str | None]:
    """The unit of the numbers, and a warning where the file claims none or another.

    A claim stands as long as the body that it makes could exist: 0.45 to 4.2 m from head to foot,
    else 2 cm to 6 m.
    """
    claimed = unit_of(claim)
    size = extent(points)
    least, most = (0.45, 4.2) if _whole_body(labels) else (0.02, 6.0)
    if not np.isfinite(size) or size <= 0:
        return (
            claimed or "mm",
            None if claimed else "the file names no unit of length; millimetres are assumed",
        )
    if claimed and least <= size * METRES[claimed] <= most:
        return claimed, None
    fitting = [unit for unit in ("mm", "cm", "m") if least <= size * METRES[unit] <= most]
    if not fitting:
        span = f"the markers span {size:.3g} {claimed or 'mm'}"
        return (
            claimed or "mm",
            f"{span}, which is no size of a body in any unit; the file's unit is kept",
        )
    unit = min(fitting, key=lambda unit: abs(np.log(size * METRES[unit] / _USUAL_M)))
    finding = f"the markers span {size * METRES[unit]:.2f} m in {unit}"
    if claimed:
        return (
            unit,
            f"the file says {claimed}, which makes a body of {size * METRES[claimed]:.3g} m: "
            f"{finding}, which is used",
        )
    named = f"no unit that is known ({claim!r})" if claim else "no unit of length"
    return unit, f"the file names {named}: {finding}, which is used"


def _whole_body(labels: Sequence[str]) -> bool:
    heights = [place.height for place in map(place_of, labels) if place]
    return bool(heights) and min(heights) < 1.0 and max(heights) > 4.5


_SURE = 0.35
_MAX_AXIS_FRAMES = 2000
# Heights on the body whose markers can tell front from back and left from right: pelvis, trunk,
# head; feet.
_PARTS = ((2.9, 3.1), (3.9, 5.1), (5.9, 6.1), (0.0, 0.3))
_PELVIS_AND_BELOW = 3.5


@dataclass(frozen=True)
class Axes:
    """The verdict: a signed up-axis such as "+z", whether the data said so, and whether the capture
    is mirrored.
    """

    up: str
    sure: bool
    mirrored: bool


@dataclass(frozen=True)
class _Heights:
    """Along one signed axis: the share of frames that begin at the floor, how steadily, and the
    body's reach.
    """

    axis: str
    on_floor: float
    wobble: float
    reach: float


def find_axes(
    labels: Sequence[str], points: Float[np.ndarray, "T M 3"], claim: str | None, usual: str
) -> Axes:
    """Up-axis and handedness of ``points`` (metres); ``claim`` is what the file says is up,
    ``usual`` a default.
    """
    points = points[:: max(1, len(points) // _MAX_AXIS_FRAMES)]
    points = points[np.isfinite(points[..., 0]).any(axis=1)]
    places = [place_of(label) for label in labels]
    spine = body_up(places, points)
    heights = {h.axis: h for h in _heights(points)}
    up = _up_of_body(spine, heights) or _up_of_floor(heights, claim)
    return Axes(up or claim or usual, up is not None, _mirrored(places, points, spine))


def body_up(
    places: Sequence[Place | None], points: Float[np.ndarray, "T M 3"]
) -> Float[np.ndarray, "T 3"]:
    """The unit vector from feet to head in each frame, NaN where too few known markers are
    visible.
    """
    known = [i for i, place in enumerate(places) if place is not None]
    if len(known) < 3:
        return np.full((len(points), 3), np.nan)
    heights = np.array([place.height for place in places if place is not None])
    seen = np.isfinite(points[:, known, 0])
    count = np.maximum(seen.sum(axis=1), 1)
    level = np.where(seen, heights, 0.0)
    level = np.where(seen, heights - level.sum(axis=1, keepdims=True) / count[:, None], 0.0)
    direction = np.einsum("tm,tmc->tc", level, np.nan_to_num(points[:, known]))
    length = np.linalg.norm(direction, axis=1)
    good = (seen.sum(axis=1) >= 3) & (np.sqrt((level**2).sum(axis=1) / count) > 0.5) & (length > 0)
    return np.where(good[:, None], direction / np.where(good, length, 1.0)[:, None], np.nan)


def _heights(points: np.ndarray) -> list[_Heights]:
    heights = []
    for i in range(3):
        values = points[..., i]
        seen = np.isfinite(values)
        low = np.where(seen, values, np.inf).min(axis=1, initial=np.inf)
        high = np.where(seen, values, -np.inf).max(axis=1, initial=-np.inf)
        reach = float(np.median(high - low)) if len(points) else 0.0
        for sign, floor in (("+", low), ("-", -high)):
            share = float(((floor > -0.1) & (floor < 0.25)).mean()) if len(points) else 0.0
            heights.append(
                _Heights(
                    f"{sign}{'xyz'[i]}", share, float(floor.std()) if len(points) else 0.0, reach
                )
            )
    return heights


def _up_of_body(spine: np.ndarray, heights: dict[str, _Heights]) -> str | None:
    """The axis along which head is above feet, unless the body lies on the floor of another
    axis.
    """
    spine = spine[np.isfinite(spine[:, 0])]
    if not len(spine):
        return None
    mean = spine.mean(axis=0)
    i = int(np.abs(mean).argmax())
    if abs(mean[i]) < _SURE:
        return None
    up = f"{'+' if mean[i] > 0 else '-'}{'xyz'[i]}"
    if heights[up].on_floor >= 0.5:
        return up
    lying = [
        h for h in heights.values() if h.axis[1] != up[1] and h.on_floor > 0.9 and h.wobble < 0.06
    ]
    lying = [h for h in lying if h.reach < 0.6 * heights[up].reach]
    return min(lying, key=lambda h: h.reach).axis if lying else up


def _up_of_floor(heights: dict[str, _Heights], claim: str | None) -> str | None:
    """Where the labels tell nothing: the axis that has a floor, with the body upright on it."""
    tallest = max(h.reach for h in heights.values())
    upright = [h for h in heights.values() if h.on_floor > 0.9 and h.reach >= max(1.0, tallest)]
    best = min(upright, key=lambda h: h.wobble, default=None)
    if claim and heights[claim].on_floor > 0.5 and (best is None or best.wobble > 0.05):
        return claim
    return best.axis if best else None


def _mirrored(places: Sequence[Place | None], points: np.ndarray, spine: np.ndarray) -> bool:
    """Whether front x left points to the feet on most parts of the body that can tell."""
    lower = [place.side if place and place.height < _PELVIS_AND_BELOW else 0 for place in places]
    votes = []
    for least, most in _PARTS:
        part = [place if place and least <= place.height <= most else None for place in places]
        front = _difference([place.depth if place else 0 for place in part], points)
        left = _difference(
            lower if most < 1.0 else [place.side if place else 0 for place in part], points
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            size = np.linalg.norm(front, axis=1) * np.linalg.norm(left, axis=1)
            share = np.einsum("tc,tc->t", np.cross(front, left), spine) / size
        share = share[np.isfinite(share)]
        if share.size:
            votes.append(float(np.median(share)))
    return sum(vote < -0.3 for vote in votes) > len(votes) / 2


def _difference(signs: Sequence[int], points: np.ndarray) -> np.ndarray:
    """(T, 3) mean of the points with sign 1 minus the mean of those with -1; NaN where either is
    unseen.
    """
    means = []
    for sign in (1, -1):
        chosen = points[:, [i for i, s in enumerate(signs) if s == sign]]
        seen = np.isfinite(chosen[..., 0]).sum(axis=1)
        means.append(np.nansum(chosen, axis=1) / np.where(seen > 0, seen, np.nan)[:, None])
    return means[0] - means[1]
