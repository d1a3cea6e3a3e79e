"""Which way is up, and are the axes right-handed: asked of the body, because files are often wrong about it.

Up: in most frames of most captures the head is above the feet. Handedness needs no world at all: on a body, front x left
points to the head; in a mirrored capture it points to the feet, however the body lies.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.io.anatomy import Place, place_of

_SURE = 0.35
_MOST_FRAMES = 2000


@dataclass(frozen=True)
class Axes:
    """The verdict: a signed up-axis, whether the data said so, and whether the capture is mirrored."""

    up: str
    sure: bool
    mirrored: bool


def find_axes(labels: Sequence[str], points: Float[np.ndarray, "T M 3"], claim: str | None) -> Axes:
    """Up-axis and handedness from the data, falling back on the file's ``claim``, then on the data's lowest claim: "+z"."""
    step = max(1, len(points) // _MOST_FRAMES)
    points = points[::step]
    places = [place_of(label) for label in labels]
    spine = body_up(places, points)
    mean = np.nanmean(spine, axis=0) if np.isfinite(spine).any() else np.zeros(3)
    axis = int(np.abs(mean).argmax())
    sure = bool(abs(mean[axis]) >= _SURE)
    up = f"{'+' if mean[axis] > 0 else '-'}{'xyz'[axis]}" if sure else claim or "+z"
    return Axes(up, sure, _mirrored(places, points, spine))


def body_up(places: Sequence[Place | None], points: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "T 3"]:
    """The unit vector from feet to head in each frame, NaN where too few known markers are visible."""
    known = [i for i, place in enumerate(places) if place is not None]
    if len(known) < 3:
        return np.full((len(points), 3), np.nan)
    heights = np.array([place.height for place in places if place is not None])
    seen = np.isfinite(points[:, known, 0])
    count = np.maximum(seen.sum(axis=1), 1)[:, None]
    level = np.where(seen, heights, 0.0)
    level = np.where(seen, heights - level.sum(axis=1, keepdims=True) / count, 0.0)
    direction = np.einsum("tm,tmc->tc", level, np.nan_to_num(points[:, known]))
    spread = np.sqrt((level**2).sum(axis=1) / count[:, 0])
    length = np.linalg.norm(direction, axis=1)
    good = (seen.sum(axis=1) >= 3) & (spread > 0.5) & (length > 0)
    return np.where(good[:, None], direction / np.where(good, length, 1.0)[:, None], np.nan)


def _mirrored(places: Sequence[Place | None], points: np.ndarray, spine: np.ndarray) -> bool:
    """Whether front x left points to the feet on most parts of the body that can tell."""
    votes = []
    for least, most in ((2.9, 3.1), (3.9, 5.1), (5.9, 6.1), (0.0, 0.3)):
        part = [place if place and least <= place.height <= most else None for place in places]
        front = _difference([p.depth if p else 0 for p in part], points)
        left = _difference([p.side if p else 0 for p in part], points)
        if most < 1.0:
            left = _difference([p.side if p and p.height < 3.5 else 0 for p in places], points)
        volume = np.einsum("tc,tc->t", np.cross(front, left), spine)
        size = np.linalg.norm(front, axis=1) * np.linalg.norm(left, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = volume / size
        share = share[np.isfinite(share)]
        if share.size:
            votes.append(float(np.median(share)))
    against = [vote for vote in votes if vote < -0.3]
    return len(against) > len(votes) / 2


def _difference(signs: Sequence[int], points: np.ndarray) -> np.ndarray:
    """(T, 3) mean of the points with sign +1 minus the mean of those with -1; NaN where either is unseen."""
    sides = []
    for sign in (1, -1):
        chosen = points[:, [i for i, s in enumerate(signs) if s == sign]]
        seen = np.isfinite(chosen[..., 0]).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            sides.append(np.nansum(chosen, axis=1) / np.where(seen > 0, seen, np.nan)[:, None])
    return sides[0] - sides[1]
