"""Gaps of a capture filled from its fit: where the body carries the marker (M 10, "fixing
occlusions").

Beside a gap the marker is off the predicted one by something that moves with the skin: placement,
noise, what the body cannot do. That offset, in the axes of the marker's triangle, goes on a
straight line through the gap from its value before to that after it, so that what is filled joins
what was seen.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float

from habitus.fit.markers.result import MarkerFit
from habitus.observe.markers import MarkerAttachment, predict_markers, triangle_bases

TRUSTED = 0.5
"""Weight of the robust loss below which a sample beside a gap does not tell where the marker sits.
"""


@dataclass(frozen=True)
class Gap:
    """A marker's frames ``first`` to ``last`` without a sample; ``why`` says why it stays empty, ""
    where it is filled.

    ``nearby`` is the median number of other markers that were seen meanwhile on the same part of
    the body or a part beside it: what is filled where that is 0 rests on the pose prior and the
    frames around.
    """

    label: str
    first: int
    last: int
    nearby: int
    why: str = ""

    @property
    def frames(self) -> int:
        """How many."""
        return self.last - self.first + 1


@dataclass(frozen=True, eq=False)
class Filling:
    """The markers with their gaps filled (T, M, 3), which samples these are (T, M), and every
    gap.
    """

    labels: tuple[str, ...]
    markers: Float[np.ndarray, "T M 3"]
    filled: Bool[np.ndarray, "T M"]
    gaps: tuple[Gap, ...]


def fill_gaps(
    fit: MarkerFit,
    observed: Float[np.ndarray, "T M 3"],
    left_out: Mapping[str, str] = MappingProxyType({}),
) -> Filling:
    """The gaps of ``observed``, in metres, the fit's frames and the order of its labels, filled
    where the fit knows.

    Empty stay frames with too few markers, gaps of markers under suspicion (what a label carries is
    not sure then), gaps whose ends do not lie on the body, and labels that are ``left_out`` for the
    reason given.
    """
    missing = ~np.isfinite(observed[..., 0])
    refused = _suspicious(fit) | dict(left_out)
    predicted, bases = _carried(fit)
    beside = _beside(fit)
    markers = np.array(observed)
    filled = np.zeros_like(missing)
    gaps = []
    for marker, label in enumerate(fit.labels):
        for first, last in runs(missing[:, marker]):
            gap = slice(first, last + 1)
            ends = [t for t in (first - 1, last + 1) if 0 <= t < len(observed)]
            near = int(np.median((~missing[gap][:, beside[marker]]).sum(1)))
            why = refused.get(label) or _refusal(fit, marker, gap, ends)
            if not why:
                off = [
                    bases[t, marker].T @ (observed[t, marker] - predicted[t, marker]) for t in ends
                ]
                placed = (
                    predicted[gap, marker]
                    + (bases[gap, marker] @ _between(off, last - first + 1)[..., None])[..., 0]
                )
                known = ~fit.flagged_frames[gap]
                markers[gap, marker] = np.where(known[:, None], placed, np.nan)
                filled[gap, marker] = known
            gaps.append(Gap(label, first, last, near, why))
    return Filling(fit.labels, markers, filled, tuple(gaps))


def _suspicious(fit: MarkerFit) -> dict[str, str]:
    return {
        each.label: f"under suspicion: {each.reason}" for each in fit.suspects if not each.corrected
    }


def _refusal(fit: MarkerFit, marker: int, gap: slice, ends: list[int]) -> str:
    if not ends:
        return "never seen"
    if fit.marker_weights[ends, marker].min() < TRUSTED:
        return "the samples beside it do not lie on the body"
    return "too few markers are seen" if fit.flagged_frames[gap].all() else ""


def _between(ends: list[np.ndarray], frames: int) -> Float[np.ndarray, "G 3"]:
    """Offsets in a gap: on the straight way from one end's to the other's, or as at the only
    end.
    """
    share = np.arange(1, frames + 1)[:, None] / (frames + 1)
    return ends[0] + share * (ends[-1] - ends[0])


def _carried(fit: MarkerFit) -> tuple[np.ndarray, np.ndarray]:
    """Predicted markers (T, M, 3) and the axes of their triangles (T, M, 3, 3)."""
    used, corners = np.unique(fit.attachment.triangles, return_inverse=True)
    attachment = MarkerAttachment(corners.reshape(-1, 3), fit.attachment.coefficients)
    points = fit.points(used)
    return predict_markers(points, attachment), triangle_bases(points, attachment.triangles).basis


def _beside(fit: MarkerFit) -> Bool[np.ndarray, "M M"]:
    """Which other markers ride on the same joint as a marker, or on one next to it in the tree."""
    body = fit.body
    strongest = body.skinning_index[np.arange(body.num_vertices), body.skinning_value.argmax(1)]
    joint = strongest[fit.attachment.triangles[:, 0]]
    parents = np.array(body.parents)
    one = joint[:, None]
    other = joint[None]
    near = (one == other) | (parents[one] == other) | (parents[other] == one)
    np.fill_diagonal(near, False)
    return near


def runs(missing: Bool[np.ndarray, " T"]) -> Iterator[tuple[int, int]]:
    """First and last frame of every run of True."""
    edges = np.flatnonzero(np.diff(missing.astype(np.int8), prepend=0, append=0))
    yield from zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True)
