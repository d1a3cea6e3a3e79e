"""Points that their values betray: exact copies and midpoints of others, and points that move with
nobody.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.markers.anatomy import place_of

_SAME_M = 0.0002
_MOST_FOR_PAIRS = 200
_STRANGE_M = 0.25


def find_copies(labels: Sequence[str], points: Float[np.ndarray, "T M 3"]) -> dict[str, str]:
    """Labels whose points are exact copies of another's or exact midpoints of two others, with the
    reason; metres.
    """
    sample = _telling_frames(points)
    found = _copies(labels, sample)
    rest = [i for i, label in enumerate(labels) if label not in found]
    return found | _midpoints([labels[i] for i in rest], sample[:, rest])


def find_strangers(labels: Sequence[str], points: Float[np.ndarray, "T M 3"]) -> dict[str, str]:
    """Labels without meaning whose distance to every marker varies by more than 25 cm: props,
    hidden angles.
    """
    sample = points[:: max(1, len(points) // 60)]
    known = [i for i, label in enumerate(labels) if place_of(label)]
    if len(known) < 10 or len(sample) < 10:
        return {}
    found = {}
    for i, label in enumerate(labels):
        if place_of(label):
            continue
        apart = np.linalg.norm(np.delete(sample, i, axis=1) - sample[:, i, None], axis=2)
        apart = apart[:, np.isfinite(apart).sum(axis=0) >= 10]
        if apart.shape[1] >= 10 and np.nanstd(apart, axis=0).min() > _STRANGE_M:
            found[label] = "moves with no other point: not on the body"
    return found


def _telling_frames(points: np.ndarray) -> np.ndarray:
    """Up to eight frames, spread over those in which most points are seen."""
    seen = np.isfinite(points[..., 0]).sum(axis=1)
    good = np.flatnonzero(seen >= max(1, 0.8 * seen.max(initial=0)))
    return points[good[np.linspace(0, len(good) - 1, min(8, len(good))).astype(int)]]


def _copies(labels: Sequence[str], sample: np.ndarray) -> dict[str, str]:
    """Of two equal points the one is kept whose name says where it is, else the first."""
    order = sorted(range(len(labels)), key=lambda i: place_of(labels[i]) is None)
    found: dict[str, str] = {}
    for rank, i in enumerate(order):
        earlier = [j for j in order[:rank] if labels[j] not in found]
        apart = np.abs(sample[:, earlier] - sample[:, i, None]).max(axis=2)
        same = np.isfinite(apart).any(axis=0) & ~(apart > _SAME_M).any(axis=0)
        if same.any():
            found[labels[i]] = f"an exact copy of {labels[earlier[int(same.argmax())]]}"
    return found


def _midpoints(labels: Sequence[str], sample: np.ndarray) -> dict[str, str]:
    if len(labels) > _MOST_FOR_PAIRS:
        return {}
    first, second = np.triu_indices(len(labels), 1)
    suspects = np.ones((len(labels), len(first)), bool)
    suspects[first, np.arange(len(first))] = suspects[second, np.arange(len(first))] = False
    shared = np.zeros_like(suspects)
    for frame in sample.astype(np.float32):
        middle = (frame[first] + frame[second]) / 2
        for axis in range(3):
            suspects &= ~(np.abs(frame[:, None, axis] - middle[None, :, axis]) > _SAME_M)
        shared |= np.isfinite(frame[:, :1]) & np.isfinite(middle[:, 0])
    found: dict[str, str] = {}
    for i, pair in np.argwhere(suspects & shared).tolist():
        one = labels[int(first[pair])]
        other = labels[int(second[pair])]
        found.setdefault(labels[i], f"the exact midpoint of {one} and {other}")
    return found
