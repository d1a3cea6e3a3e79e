"""Faults of markers, to be planted in a clean capture: what goes wrong on a person or in tracking
and labelling.

Markers are (T, M, 3) in metres, NaN where missing; every function gives a changed copy.
"""

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError

Markers = Float[np.ndarray, "T M 3"]


def swapped(markers: Markers, first: int, second: int, frames: slice = slice(None)) -> Markers:
    """Two markers under each other's labels in some frames."""
    out = markers.copy()
    out[frames, first], out[frames, second] = markers[frames, second], markers[frames, first]
    return out


def fallen(markers: Markers, marker: int, frame: int, rate_hz: float, up: str = "+z") -> Markers:
    """A marker that falls off at a frame, freely, down to the lowest marker's height, and lies
    there.
    """
    sign = -1.0 if up.startswith("-") else 1.0
    axis = "xyz".find(up[-1:])
    if axis < 0:
        raise HabitusError(f"up is {up!r}; expected an axis such as +y or +z")
    out = markers.copy()
    seen = np.flatnonzero(np.isfinite(markers[: frame + 1, marker, 0]))
    if not len(seen):
        raise HabitusError(
            f"marker {marker} is not seen before frame {frame}, so it cannot fall; take another "
            "frame"
        )
    last = markers[seen[-1], marker]
    height = sign * last[axis]
    floor = np.nanmin(sign * markers[..., axis])
    seconds = np.arange(len(markers) - frame) / rate_hz
    out[frame:, marker] = last
    out[frame:, marker, axis] = sign * np.maximum(height - 4.905 * seconds**2, floor)
    return out


def ghost(markers: Markers, marker: int, frames: slice, offset: Float[np.ndarray, "3"]) -> Markers:
    """Something else under a marker's label for a while: a reflection that stands still, ``offset``
    from the marker.
    """
    out = markers.copy()
    seen = np.flatnonzero(np.isfinite(markers[frames, marker, 0]))
    if len(seen):
        out[frames, marker] = markers[frames, marker][seen[0]] + offset
    return out


def wrong_label(markers: Markers, marker: int, between: tuple[int, int]) -> Markers:
    """A label that another marker carries throughout: one that sits midway between two others."""
    out = markers.copy()
    out[:, marker] = 0.5 * (markers[:, between[0]] + markers[:, between[1]])
    return out


def drifting(
    markers: Markers, marker: int, turns: Float[np.ndarray, "T 3 3"], way: Float[np.ndarray, "3"]
) -> Markers:
    """A marker that slides evenly over the skin by ``way`` (m, in the limb's own axes; ``turns``
    takes them to the world's).
    """
    out = markers.copy()
    share = np.linspace(0.0, 1.0, len(markers))
    out[:, marker] += share[:, None] * (turns @ np.asarray(way, dtype=float))
    return out


def lost(markers: Markers, share: float, rng: np.random.Generator) -> Markers:
    """Samples lost at random, each by itself."""
    out = markers.copy()
    out[rng.random(markers.shape[:2]) < share] = np.nan
    return out


def gap(markers: Markers, which: np.ndarray | slice, frames: slice) -> Markers:
    """Some markers (indices, or a slice for all) unseen for a while."""
    out = markers.copy()
    out[frames, which] = np.nan
    return out
