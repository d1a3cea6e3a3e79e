"""What each tracklet is called: costs averaged over its points, matched frame by frame, and how
sure that is.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.kernels import assign_frames, squared_distances

_FAR = 0.30
LEAST_SPREAD = 0.012
NOTHING = float(np.exp(-6.0))
LIKELY = 0.5
FARTHEST = 12.0


def distances(clouds: Clouds, predicted: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "P M"]:
    """Squared distance of each point from each predicted marker of its frame, cut at 30 cm."""
    out = np.empty((len(clouds.points), predicted.shape[1]))
    squared_distances(clouds.points, clouds.start, predicted, _FAR**2, out)
    return out


def averaged(
    values: Float[np.ndarray, "P M"], tracklet: Int[np.ndarray, " P"]
) -> Float[np.ndarray, "P M"]:
    """Each point's values as the mean over its tracklet."""
    order = np.argsort(tracklet, kind="stable")
    first = np.flatnonzero(np.diff(tracklet[order], prepend=-1))
    sums = np.add.reduceat(values[order], first, axis=0)
    counts = np.diff(np.append(first, len(order)))
    return (sums / counts[:, None])[tracklet]


def assign(
    costs: Float[np.ndarray, "P M"], clouds: Clouds, gates: Float[np.ndarray, " P"]
) -> Int[np.ndarray, " P"]:
    """The label of each point, -1 where every one costs more than its gate; no label twice in a
    frame.
    """
    label = np.empty(len(costs), dtype=np.int64)
    assign_frames(np.ascontiguousarray(costs), clouds.start, gates, label)
    return label


def judged(
    squared: Float[np.ndarray, "P M"],
    label: Int[np.ndarray, " P"],
    tracklet: Int[np.ndarray, " P"],
    clouds: Clouds,
    sure: Float[np.ndarray, " M"],
) -> tuple[Int[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Labels less those that are not likely, and each point's confidence in its label or in the
    best one refused.
    """
    known = label >= 0
    rows = np.flatnonzero(known)
    own = np.sqrt(squared[rows, label[rows]])
    spread = np.full(squared.shape[1], LEAST_SPREAD)
    typical = np.median(own) if len(own) else LEAST_SPREAD
    for i in range(len(spread)):
        mine = own[label[rows] == i]
        spread[i] = np.clip(
            np.median(mine) if len(mine) else typical,
            LEAST_SPREAD,
            max(2.0 * typical, LEAST_SPREAD),
        )
    off = averaged(np.minimum(squared / (2.0 * spread**2), 50.0), tracklet)
    alone = np.minimum(squared / (2.0 * spread**2), 50.0)
    likely = np.exp(-off)
    share = likely / (likely.sum(axis=1, keepdims=True) + NOTHING)
    best = np.where(known, label, share.argmax(axis=1))
    each = np.arange(len(label))
    confidence = share[each, best] * sure[best]
    kept = known & (share[each, best] >= LIKELY) & (alone[each, best] < FARTHEST)
    return np.where(kept, label, -1), confidence
