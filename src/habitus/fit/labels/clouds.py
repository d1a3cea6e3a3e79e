"""Unlabelled points: frame after frame, the tracklets that they make in time, and tracklets packed
into few trajectories.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.fit.labels.kernels import link
from habitus.fit.labels.settings import TRACKLETS, TrackletSettings


@dataclass(frozen=True)
class Clouds:
    """P points of T frames, one frame after the other: ``points[start[t] : start[t + 1]]`` are
    those of frame t.

    ``column``: where each point stood among its frame's. Metres.
    """

    points: Float[np.ndarray, "P 3"]
    start: Int[np.ndarray, " T1"]
    column: Int[np.ndarray, " P"]
    rate_hz: float
    up_axis: str

    @staticmethod
    def of(markers: Float[np.ndarray, "T N 3"], rate_hz: float, up_axis: str) -> "Clouds":
        """The points that are there of N trajectories."""
        seen = np.isfinite(markers).all(axis=2)
        start = np.concatenate([[0], np.cumsum(seen.sum(axis=1))]).astype(np.int64)
        points = np.ascontiguousarray(markers[seen], dtype=np.float64)
        return Clouds(points, start, np.nonzero(seen)[1], float(rate_hz), up_axis)

    def __len__(self) -> int:
        """T."""
        return len(self.start) - 1

    @property
    def frame(self) -> Int[np.ndarray, " P"]:
        """The frame of each point."""
        return np.repeat(np.arange(len(self)), np.diff(self.start))

    def labelled(self, label: Int[np.ndarray, " P"], count: int) -> Float[np.ndarray, "T M 3"]:
        """Markers (T, M, 3) by each point's label, NaN where none has it; -1 is no label."""
        markers = np.full((len(self), count, 3), np.nan)
        known = label >= 0
        markers[self.frame[known], label[known]] = self.points[known]
        return markers


def tracklets(clouds: Clouds, settings: TrackletSettings = TRACKLETS) -> Int[np.ndarray, " P"]:
    """The tracklet of each point, numbered from 0: pieces of trajectories in which each step is
    beyond doubt.
    """
    gate = max(settings.gate, 1.5 / clouds.rate_hz)
    linked = link(
        clouds.points,
        clouds.start,
        gate,
        settings.speed / clouds.rate_hz + 0.005,
        settings.max_gap,
        settings.ratio,
    )
    return np.unique(linked, return_inverse=True)[1]


def telling_frames(clouds: Clouds, count: int) -> Int[np.ndarray, " F"]:
    """Frames spread over time, each the fullest of its stretch."""
    sizes = np.diff(clouds.start)
    edges = np.linspace(0, len(clouds), min(count, len(clouds)) + 1).astype(int)
    picked = [a + int(np.argmax(_calm(sizes[a:b]))) for a, b in pairwise(edges)]
    return np.array([t for t in picked if sizes[t] > 0], dtype=np.int64)


def _calm(sizes: np.ndarray) -> Float[np.ndarray, " N"]:
    """The fullest frames first, those in the middle of a stretch before others."""
    middle = np.abs(np.arange(len(sizes)) - len(sizes) / 2)
    return sizes - middle / (len(sizes) + 1.0)


def packed(
    clouds: Clouds, tracklet: Int[np.ndarray, " P"], chosen: Bool[np.ndarray, " P"]
) -> Float[np.ndarray, "T K 3"]:
    """The chosen points (T, K, 3), those of a tracklet in one column, NaN where a column has
    none.
    """
    points = np.flatnonzero(chosen)
    frame = clouds.frame[points]
    piece = tracklet[points]
    ends: list[int] = []
    column = np.empty(int(tracklet.max(initial=0)) + 1, dtype=np.int64)
    first = np.full(len(column), len(clouds))
    last = np.full(len(column), -1)
    np.minimum.at(first, piece, frame)
    np.maximum.at(last, piece, frame)
    for k in np.argsort(first, kind="stable"):
        if last[k] < 0:
            continue
        free = next((c for c, end in enumerate(ends) if end < first[k]), len(ends))
        if free == len(ends):
            ends.append(-1)
        column[k], ends[free] = free, int(last[k])
    out = np.full((len(clouds), len(ends), 3), np.nan)
    out[frame, column[piece]] = clouds.points[points]
    return out
