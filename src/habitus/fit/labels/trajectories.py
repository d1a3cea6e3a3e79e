"""Points without names as few trajectories: pieces that do not overlap share one."""

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.fit.labels.clouds import Clouds


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
