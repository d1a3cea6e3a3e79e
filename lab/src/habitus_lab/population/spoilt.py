"""Captures spoilt as wholes, as bad exports and wrong choices spoil them: what a verdict must never
call good.

Each kind takes markers (T, M, 3) in metres, NaN where missing, with the layout's columns, and gives
a copy. The axis that is up is z in what is said below.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from habitus.rotations import matrix_from_rotvec

Markers = Float[np.ndarray, "T M 3"]
Spoiling = Callable[[Markers, np.random.Generator], Markers]


def _shuffled(share: float) -> Spoiling:
    """So many of the labels, each on another marker than its own."""

    def spoil(markers: Markers, rng: np.random.Generator) -> Markers:
        count = markers.shape[1]
        chosen = rng.permutation(count)[: max(3, round(share * count))]
        order = np.arange(count)
        order[chosen] = np.roll(chosen, 1)
        return markers[:, order]

    return spoil


def _scaled(factor: float) -> Spoiling:
    return lambda markers, rng: factor * markers


def _two_people(markers: Markers, rng: np.random.Generator) -> Markers:
    """Half of the markers are those of somebody else, who moves on another way 1.2 m beside."""
    middle = np.nanmean(markers, axis=(0, 1))
    turn = matrix_from_rotvec(np.array([0.0, 0.0, 2.0]))
    other = (markers[::-1] - middle) @ turn.T + middle + [1.2, 0.0, 0.0]
    theirs = rng.permutation(markers.shape[1])[: markers.shape[1] // 2]
    out = markers.copy()
    out[:, theirs] = other[:, theirs]
    return out


def _columns_shifted(markers: Markers, rng: np.random.Generator) -> Markers:
    """Every coordinate read two columns late, as from a table whose labels do not stand above their
    columns.
    """
    return np.roll(markers.reshape(len(markers), -1), -2, axis=1).reshape(markers.shape)


def _mirrored(axis: int) -> Spoiling:
    return lambda markers, rng: markers * np.where(np.arange(3) == axis, -1.0, 1.0)


def _lying(markers: Markers, rng: np.random.Generator) -> Markers:
    """Turned by a right angle, as by a wrong axis up."""
    return markers[..., [1, 2, 0]]


def _frames_shuffled(markers: Markers, rng: np.random.Generator) -> Markers:
    """Frames in random order."""
    return markers[rng.permutation(len(markers))]


def _constant(share: float) -> Spoiling:
    """So many of the markers stay where they were first seen."""

    def spoil(markers: Markers, rng: np.random.Generator) -> Markers:
        out = markers.copy()
        for k in rng.permutation(markers.shape[1])[: round(share * markers.shape[1])]:
            seen = np.isfinite(markers[:, k, 0])
            out[seen, k] = markers[seen, k][:1]
        return out

    return spoil


def _offset(length: float) -> Spoiling:
    """Each marker is this far (m) from its place, in a direction of its own."""

    def spoil(markers: Markers, rng: np.random.Generator) -> Markers:
        way = rng.normal(size=(markers.shape[1], 3))
        return markers + length * way / np.linalg.norm(way, axis=1, keepdims=True)

    return spoil


def _noisy(sd: float) -> Spoiling:
    """Each coordinate of each sample is off by this standard deviation (m)."""
    return lambda markers, rng: markers + sd * rng.normal(size=markers.shape)


def _frozen(markers: Markers, rng: np.random.Generator) -> Markers:
    """One frame over and over."""
    return np.repeat(markers[:1], len(markers), axis=0)


SPOILINGS: Mapping[str, Spoiling] = {
    "labels shuffled": _shuffled(1.0),
    "a third of the labels shuffled": _shuffled(0.34),
    "scaled by 10": _scaled(10.0),
    "scaled by 0.1": _scaled(0.1),
    "scaled by 1.3": _scaled(1.3),
    "two people": _two_people,
    "columns shifted": _columns_shifted,
    "mirrored": _mirrored(0),
    "upside down and mirrored": _mirrored(2),
    "axes turned": _lying,
    "frames shuffled": _frames_shuffled,
    "half of the markers constant": _constant(0.5),
    "offsets of 40 mm": _offset(0.040),
    "noise of 30 mm": _noisy(0.030),
    "scaled by 0.8": _scaled(0.8),
    "scaled by 1.25": _scaled(1.25),
    "feet for metres": _scaled(3.2808),
    "frozen": _frozen,
}
"""Kinds of spoilt capture."""
