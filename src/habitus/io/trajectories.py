"""Cleaning trajectories: what counts as missing, fragments of one marker joined, copies and means of others found."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_FRAGMENT = re.compile(r"(.+?)(?:-|_|\.)(\d{1,2})")
_AGREE_M = 0.03
_COPY_M = 0.0002


def hide_placeholders(points: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "T M 3"]:
    """A copy in which points at exactly (0, 0, 0), and points with a coordinate that is not finite, are NaN."""
    gone = ~np.isfinite(points).all(axis=2) | ~points.any(axis=2)
    hidden = points.copy()
    hidden[gone] = np.nan
    return hidden


def join_fragments(
    labels: Sequence[str], points: Float[np.ndarray, "T M 3"]
) -> tuple[tuple[str, ...], np.ndarray, tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Labels made unique and pieces of one marker joined: ``LFHD`` twice, ``RBAC-1`` into ``RBAC``.

    Pieces join where they never disagree in a frame. Returns labels, points (metres), what was left out with its reason,
    and warnings.
    """
    kept: dict[str, np.ndarray] = {}
    dropped: list[tuple[str, str]] = []
    warnings: list[str] = []
    for column, label in _bases_first(labels):
        base = _base(label, kept)
        track = points[:, column]
        if base is None:
            kept[label] = track.copy()
        elif _agree(kept[base], track):
            _fill(kept[base], track)
            dropped.append((label, f"a fragment or copy of {base}, joined to it"))
        elif label == base and re.fullmatch(r"[LR](HIP|KNE|ANK)", label):
            dropped.append((label, "a second point of this name is the joint centre"))
        elif label == base:
            name = _next_name(label, {*kept, *labels})
            kept[name] = track.copy()
            warnings.append(f"two different points are labelled {label}: the second is kept as {name}")
        else:
            kept[label] = track.copy()
    order = [label for label in dict.fromkeys((*labels, *kept)) if label in kept]
    joined = np.stack([kept[label] for label in order], axis=1) if order else points[:, :0]
    return tuple(order), joined, tuple(dropped), tuple(warnings)


def _bases_first(labels: Sequence[str]) -> list[tuple[int, str]]:
    """Columns with their labels, names before their numbered fragments."""
    present = set(labels)
    return sorted(enumerate(labels), key=lambda item: _stem(item[1]) in present)


def _stem(label: str) -> str | None:
    match = _FRAGMENT.fullmatch(label)
    return match[1] if match else None


def _base(label: str, kept: dict[str, np.ndarray]) -> str | None:
    if label in kept:
        return label
    stem = _stem(label)
    return stem if stem in kept else None


def _agree(one: np.ndarray, other: np.ndarray) -> bool:
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(one - other, axis=1)
    return not (apart > _AGREE_M).any()


def _fill(track: np.ndarray, fragment: np.ndarray) -> None:
    empty = np.isnan(track[:, 0])
    track[empty] = fragment[empty]


def _next_name(label: str, taken: set[str]) -> str:
    return next(name for i in range(2, 1000) if (name := f"{label}_{i}") not in taken)


def find_copies(labels: Sequence[str], points: Float[np.ndarray, "T M 3"]) -> dict[str, str]:
    """Labels whose points are exact copies of an earlier label's, or exact midpoints of two others, with the reason."""
    frames = _telling_frames(points)
    if len(frames) == 0 or len(labels) < 2:
        return {}
    sample = points[frames]
    found = _copies(labels, sample)
    rest = [i for i, label in enumerate(labels) if label not in found]
    return found | _midpoints([labels[i] for i in rest], sample[:, rest])


def _telling_frames(points: np.ndarray) -> np.ndarray:
    """Up to eight frames, spread over those in which most markers are seen."""
    seen = np.isfinite(points[..., 0]).sum(axis=1)
    good = np.flatnonzero(seen >= max(1, 0.8 * seen.max(initial=0)))
    return good[np.linspace(0, len(good) - 1, min(8, len(good))).astype(int)] if len(good) else good


def _copies(labels: Sequence[str], sample: np.ndarray) -> dict[str, str]:
    found: dict[str, str] = {}
    for i in range(1, len(labels)):
        with np.errstate(invalid="ignore"):
            apart = np.linalg.norm(sample[:, :i] - sample[:, i : i + 1], axis=2)
        shared = np.isfinite(apart).sum(axis=0)
        same = (shared >= 1) & ~(apart > _COPY_M).any(axis=0)
        twin = next((j for j in np.flatnonzero(same) if labels[j] not in found), None)
        if twin is not None:
            found[labels[i]] = f"an exact copy of {labels[twin]}"
    return found


def _midpoints(labels: Sequence[str], sample: np.ndarray) -> dict[str, str]:
    count = len(labels)
    if count < 3:
        return {}
    first, second = np.triu_indices(count, 1)
    suspects = np.ones((count, len(first)), bool)
    suspects[first, np.arange(len(first))] = suspects[second, np.arange(len(first))] = False
    shared = np.zeros((count, len(first)), int)
    for frame in sample.astype(np.float32):
        middle = (frame[first] + frame[second]) / 2
        near = np.ones_like(suspects)
        for axis in range(3):
            near &= ~(np.abs(frame[:, None, axis] - middle[None, :, axis]) > _COPY_M)
        suspects &= near
        shared += np.isfinite(frame[:, 0])[:, None] & np.isfinite(middle[:, 0])[None]
    found = {}
    for i, pair in zip(*np.nonzero(suspects & (shared >= 1)), strict=True):
        found.setdefault(labels[i], f"the exact midpoint of {labels[first[pair]]} and {labels[second[pair]]}")
    return found
