"""Metres, whatever the file says: its unit is read, then checked against the size of the body that
its numbers make.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.markers.labels import place_of

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
    found = f"the markers span {size * METRES[unit]:.2f} m in {unit}"
    if claimed:
        return (
            unit,
            f"the file says {claimed}, which makes a body of {size * METRES[claimed]:.3g} m: "
            f"{found}, which is used",
        )
    named = f"no unit that is known ({claim!r})" if claim else "no unit of length"
    return unit, f"the file names {named}: {found}, which is used"


def _whole_body(labels: Sequence[str]) -> bool:
    heights = [place.height for place in map(place_of, labels) if place]
    return bool(heights) and min(heights) < 1.0 and max(heights) > 4.5
