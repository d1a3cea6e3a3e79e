"""What each tracklet is called: costs averaged over its points, matched frame by frame, and how sure that is."""

import numpy as np
from jaxtyping import Float, Int

from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.kernels import assign_frames, squared_distances

_FAR = 0.30


def distances(clouds: Clouds, predicted: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "P M"]:
    """Squared distance of each point from each predicted marker of its frame, cut at 30 cm."""
    out = np.empty((len(clouds.points), predicted.shape[1]))
    squared_distances(clouds.points, clouds.start, predicted, _FAR**2, out)
    return out


def averaged(values: Float[np.ndarray, "P M"], tracklet: Int[np.ndarray, " P"]) -> Float[np.ndarray, "P M"]:
    """Each point's values as the mean over its tracklet."""
    order = np.argsort(tracklet, kind="stable")
    first = np.flatnonzero(np.diff(tracklet[order], prepend=-1))
    sums = np.add.reduceat(values[order], first, axis=0)
    counts = np.diff(np.append(first, len(order)))
    return (sums / counts[:, None])[tracklet]


def assign(costs: Float[np.ndarray, "P M"], clouds: Clouds, gates: Float[np.ndarray, " P"]) -> Int[np.ndarray, " P"]:
    """The label of each point, -1 where every one costs more than its gate; no label twice in a frame."""
    label = np.empty(len(costs), dtype=np.int64)
    assign_frames(np.ascontiguousarray(costs), clouds.start, gates, label)
    return label


def settled(label: Int[np.ndarray, " P"], tracklet: Int[np.ndarray, " P"], count: int) -> Int[np.ndarray, " P"]:
    """The label that most of a tracklet's points have, for those that have it; -1 for the others."""
    votes = np.zeros((int(tracklet.max()) + 1, count + 1), dtype=np.int64)
    np.add.at(votes, (tracklet, label), 1)  # -1 is the last column
    winner = votes.argmax(axis=1)[tracklet]
    return np.where(winner == np.where(label < 0, count, label), label, -1)
