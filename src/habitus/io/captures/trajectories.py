"""Trajectories of a file cleaned: stuck, distant, placeholder and fragmented ones; duplicate, mid-
point and off-body markers detected.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.arrays import runs
from habitus.markers.labels import place_of
from habitus.parallel.blocks import blocks, drop_pages, mapped

_FRAGMENT = re.compile(r"(.+?)(?:-|_|\.)(\d{1,2})")
_JOINT = re.compile(r"[LR](HIP|KNE|ANK)")
_AGREE_M = 0.03
_FARTHEST = 9e6  # 9999999 is some systems' word for missing
_FAR_M = 1000.0
_SAMPLE = 200
_NAMED = 8
_STUCK_FRAMES = 5
_STUCK_M = 0.05


@dataclass(frozen=True)
class Tracks:
    """Labels with their points (T, M, 3) in metres, what was left out with its reason, and
    warnings.
    """

    labels: tuple[str, ...]
    points: Float[np.ndarray, "T M 3"]
    dropped: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def visible(self) -> list[bool]:
        """Whether each point is seen in any frame."""
        seen = np.zeros(len(self.labels), dtype=bool)
        for part in blocks(len(self.points)):
            seen |= np.isfinite(self.points[part, :, 0]).any(axis=0)
        drop_pages(self.points)
        return seen.tolist()

    def keep(self, mask: Sequence[bool]) -> "Tracks":
        """The tracks where ``mask`` holds, with what was dropped and warned of so far."""
        if all(mask):
            return self
        kept = [i for i, keep in enumerate(mask) if keep]
        labels = tuple(self.labels[i] for i in kept)
        points = mapped(lambda part: np.ascontiguousarray(part[:, kept]), self.points)
        return Tracks(labels, points, self.dropped, self.warnings)

    def without(self, reasons: dict[str, str]) -> "Tracks":
        """The tracks less the labels in ``reasons``, which join the dropped."""
        kept = self.keep([label not in reasons for label in self.labels])
        gone = tuple((label, reasons[label]) for label in self.labels if label in reasons)
        return Tracks(kept.labels, kept.points, (*self.dropped, *gone), self.warnings)


def hide_placeholders(points: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "T M 3"]:
    """A copy with NaN for points at exactly (0, 0, 0), not finite, or absurdly far (9 million
    units).
    """
    return mapped(_without_placeholders, points)


def _without_placeholders(points: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        good = (np.abs(points).max(axis=2, initial=0.0) < _FARTHEST) & points.any(axis=2)
    return np.where(good[..., None], points, np.nan)


def hide_far(tracks: Tracks) -> Tracks:
    """Hides points more than a kilometre from the middle of all (metres): whatever they are, they
    are not on a body.
    """
    sample = tracks.points[:: max(1, len(tracks.points) // _SAMPLE)]
    seen = sample[np.isfinite(sample[..., 0])]
    if not len(seen):
        return tracks
    middle = np.median(seen, axis=0)
    far = mapped(lambda part: _beyond(part, middle, _FAR_M), tracks.points)
    counts = {
        label: n for label, n in zip(tracks.labels, far.sum(axis=0).tolist(), strict=True) if n
    }
    if not counts:
        return tracks
    hidden = mapped(lambda part, away: np.where(away[..., None], np.nan, part), tracks.points, far)
    named = ", ".join(
        f"{label} ({frames} frames)" for label, frames in list(counts.items())[:_NAMED]
    )
    warning = f"points more than a kilometre from the rest are missing there: {named}"
    return Tracks(tracks.labels, hidden, tracks.dropped, (*tracks.warnings, warning))


def _beyond(points: np.ndarray, middle: np.ndarray, reach: float) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.abs(points - middle).max(axis=2) > reach


def hide_stuck(tracks: Tracks) -> Tracks:
    """Hides a point while it stands exactly still and its neighbours move away, as some files hold
    lost markers.
    """
    points = tracks.points
    if len(points) < _STUCK_FRAMES or points.shape[1] < 4:
        return tracks
    still = mapped(lambda now, before: (now == before).all(axis=2), points[1:], points[:-1])
    columns = np.flatnonzero(still.any(axis=0)).tolist()
    if not columns:
        return tracks
    hidden = mapped(np.array, points)
    counts = {}
    for column in columns:
        near = _neighbours(points, column)
        for start, stop in _runs(still[:, column], _STUCK_FRAMES - 1):
            if _left_behind(points[start : stop + 1], column, near):
                hidden[start : stop + 1, column] = np.nan
                counts[tracks.labels[column]] = (
                    counts.get(tracks.labels[column], 0) + stop + 1 - start
                )
    if not counts:
        return tracks
    named = ", ".join(
        f"{label} ({frames} frames)" for label, frames in list(counts.items())[:_NAMED]
    )
    warning = f"points fixed while their neighbours move are treated as missing there: {named}"
    return Tracks(tracks.labels, hidden, tracks.dropped, (*tracks.warnings, warning))


def _neighbours(points: np.ndarray, column: int) -> np.ndarray:
    """The three points nearest to one, by the mean of their distance."""
    sample = points[:: max(1, len(points) // 40)]
    distances = np.linalg.norm(sample - sample[:, column, None], axis=2)
    shared = np.isfinite(distances).sum(axis=0)
    mean = np.where(shared > 0, np.nansum(distances, axis=0) / np.maximum(shared, 1), np.inf)
    mean[column] = np.inf
    return np.argsort(mean)[:3]


def _runs(still: np.ndarray, least: int) -> Iterator[tuple[int, int]]:
    """(first frame, last frame) of each run of at least ``least`` steps without movement."""
    return ((start, stop) for start, stop in runs(still) if stop - start >= least)


def _left_behind(points: np.ndarray, column: int, near: np.ndarray) -> bool:
    points = points[:: max(1, len(points) // 100)]
    distances = np.linalg.norm(points[:, near] - points[:, column, None], axis=2)
    distances = distances[:, np.isfinite(distances).sum(axis=0) >= 2]
    if distances.shape[1] < 2:
        return False
    return bool((np.nanmax(distances, axis=0) - np.nanmin(distances, axis=0) > _STUCK_M).all())


def join_fragments(tracks: Tracks) -> Tracks:
    """Labels made unique and pieces of one marker joined: ``LFHD`` twice, ``RBAC-1`` into ``RBAC``.

    Pieces join where they are never 3 cm apart in a frame that has both.
    """
    present = set(tracks.labels)
    if len(present) == len(tracks.labels) and not any(_stem(label) in present for label in present):
        return tracks
    kept: dict[str, np.ndarray] = {}
    dropped: list[tuple[str, str]] = []
    renamed: list[str] = []
    numbers: dict[str, int] = {}  # that the next point of a label tries
    for column, label in _whole_names_first(tracks.labels):
        track = tracks.points[:, column].copy()
        base = label if label in kept else _stem(label)
        if base not in kept:
            kept[label] = track
        elif _agree(kept[base], track):
            empty = np.isnan(kept[base][:, 0])
            kept[base][empty] = track[empty]
            dropped.append((label, f"a piece or copy of {base}, joined to it"))
        elif label != base:
            kept[label] = track
        elif _JOINT.fullmatch(label):
            dropped.append((label, "the second point of this name is the joint's centre"))
        else:
            name, numbers[label] = _next_name(label, numbers.get(label, 2), present, kept)
            kept[name] = track
            renamed.append(name)
    order = [label for label in dict.fromkeys((*tracks.labels, *kept)) if label in kept]
    points = np.stack([kept[label] for label in order], axis=1) if order else tracks.points[:, :0]
    notes = (
        (f"different points share a label: the later ones are kept as {', '.join(renamed)}",)
        if renamed
        else ()
    )
    return Tracks(tuple(order), points, (*tracks.dropped, *dropped), (*tracks.warnings, *notes))


def _whole_names_first(labels: Sequence[str]) -> list[tuple[int, str]]:
    present = set(labels)
    return sorted(enumerate(labels), key=lambda item: _stem(item[1]) in present)


def _stem(label: str) -> str:
    match = _FRAGMENT.fullmatch(label)
    return match[1] if match else ""


def _agree(one: np.ndarray, other: np.ndarray) -> bool:
    return not (np.linalg.norm(one - other, axis=1) > _AGREE_M).any()


def _next_name(
    label: str, number: int, present: Collection[str], kept: Collection[str]
) -> tuple[str, int]:
    """The label with the first free number from this one on, and the number after it."""
    while (name := f"{label}_{number}") in present or name in kept:
        number += 1
    return name, number + 1


_SAME_M = 0.0002
_MAX_FOR_PAIRS = 200
_STRANGE_M = 0.25


def duplicate_points(labels: Sequence[str], points: Float[np.ndarray, "T M 3"]) -> dict[str, str]:
    """Labels whose points are exact copies of another's or exact midpoints of two others, with the
    reason; metres.
    """
    sample = _telling_frames(points)
    dropped = _copies(labels, sample)
    rest = [i for i, label in enumerate(labels) if label not in dropped]
    return dropped | _midpoints([labels[i] for i in rest], sample[:, rest])


def off_body_points(labels: Sequence[str], points: Float[np.ndarray, "T M 3"]) -> dict[str, str]:
    """Labels without meaning whose distance to every marker varies by more than 25 cm: props,
    hidden angles.
    """
    sample = points[:: max(1, len(points) // 60)]
    known = [i for i, label in enumerate(labels) if place_of(label)]
    if len(known) < 10 or len(sample) < 10:
        return {}
    dropped = {}
    for i, label in enumerate(labels):
        if place_of(label):
            continue
        distances = np.linalg.norm(np.delete(sample, i, axis=1) - sample[:, i, None], axis=2)
        distances = distances[:, np.isfinite(distances).sum(axis=0) >= 10]
        if distances.shape[1] >= 10 and np.nanstd(distances, axis=0).min() > _STRANGE_M:
            dropped[label] = "moves with no other point: not on the body"
    return dropped


def _telling_frames(points: np.ndarray) -> np.ndarray:
    """Up to eight frames, spread over those in which most points are seen."""
    seen = np.isfinite(points[..., 0]).sum(axis=1)
    good = np.flatnonzero(seen >= max(1, 0.8 * seen.max(initial=0)))
    return points[good[np.linspace(0, len(good) - 1, min(8, len(good))).astype(int)]]


def _copies(labels: Sequence[str], sample: np.ndarray) -> dict[str, str]:
    """Of two equal points the one is kept whose name says where it is, else the first."""
    order = sorted(range(len(labels)), key=lambda i: place_of(labels[i]) is None)
    dropped: dict[str, str] = {}
    for rank, i in enumerate(order):
        earlier = [j for j in order[:rank] if labels[j] not in dropped]
        distances = np.abs(sample[:, earlier] - sample[:, i, None]).max(axis=2)
        same = np.isfinite(distances).any(axis=0) & ~(distances > _SAME_M).any(axis=0)
        if same.any():
            dropped[labels[i]] = f"an exact copy of {labels[earlier[int(same.argmax())]]}"
    return dropped


def _midpoints(labels: Sequence[str], sample: np.ndarray) -> dict[str, str]:
    if len(labels) > _MAX_FOR_PAIRS:
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
    dropped: dict[str, str] = {}
    for i, pair in np.argwhere(suspects & shared).tolist():
        one = labels[int(first[pair])]
        other = labels[int(second[pair])]
        dropped.setdefault(labels[i], f"the exact midpoint of {one} and {other}")
    return dropped
