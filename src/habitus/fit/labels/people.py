"""Points of several people in one volume, parted before they are labelled and once more by the
bodies that were found.

First by where people stand: in each frame the points' places on the ground fall into so many heaps,
followed from frame to frame, and a tracklet belongs to the heap that it is nearest to on average.
An arm that reaches over another person is wrong then; so when each person's body is known, every
tracklet goes to the body whose markers pass nearest to it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.votes import averaged, distances

ROUNDS = 8
TRIED = 24  # frames of which the one begins whose heaps lie clearest apart


def heaps(clouds: Clouds, tracklet: Int[np.ndarray, " P"], count: int) -> Int[np.ndarray, " P"]:
    """The person, 0 to ``count`` - 1, of each point, by where people stand."""
    up = "xyz".index(clouds.up_axis[1])
    ground = np.delete(clouds.points, up, axis=1)
    middles = _followed(ground, clouds.start, count)
    apart = np.sum((ground[:, None] - middles[clouds.frame]) ** 2, axis=2)
    return averaged(apart, tracklet).argmin(axis=1)


def nearest_bodies(
    clouds: Clouds, tracklet: Int[np.ndarray, " P"], predicted: Sequence[Float[np.ndarray, "T M 3"]]
) -> Int[np.ndarray, " P"]:
    """The person of each point, by the predicted markers (of each person) that its tracklet passes
    nearest to.
    """
    nearest = [averaged(distances(clouds, markers), tracklet).min(axis=1) for markers in predicted]
    return np.argmin(nearest, axis=0)


def only(clouds: Clouds, chosen: Bool[np.ndarray, " P"]) -> Clouds:
    """Some of the points, frames as they were."""
    start = np.concatenate(
        [[0], np.cumsum(np.bincount(clouds.frame[chosen], minlength=len(clouds)))]
    )
    return replace(
        clouds,
        points=clouds.points[chosen],
        start=start.astype(np.int64),
        column=clouds.column[chosen],
    )


def _followed(
    ground: Float[np.ndarray, "P 2"], start: Int[np.ndarray, " T1"], count: int
) -> Float[np.ndarray, "T K 2"]:
    """Cluster centres in every frame, tracked in both directions from the frame with the best
    separated clusters.
    """
    frames = len(start) - 1
    sizes = np.diff(start)
    full = np.flatnonzero(sizes >= count)[:: max(1, frames // TRIED)]
    first, middles = max(
        ((t, _heaped(ground[start[t] : start[t + 1]], count)) for t in full), key=_clearness
    )
    found = np.empty((frames, count, 2))
    for way in (range(first, frames), range(first, -1, -1)):
        here = middles
        for t in way:
            here = _settled(ground[start[t] : start[t + 1]], here)
            found[t] = here
    return found


def _clearness(tried: tuple[int, np.ndarray]) -> float:
    middles = tried[1]
    apart = np.linalg.norm(middles[:, None] - middles, axis=2)
    return float(apart[~np.eye(len(middles), dtype=bool)].min(initial=np.inf))


def _heaped(points: Float[np.ndarray, "n 2"], count: int) -> Float[np.ndarray, "K 2"]:
    """Heaps of one frame, begun at points far from each other."""
    begin = [np.median(points, axis=0)]
    begin = [points[np.argmax(np.linalg.norm(points - begin[0], axis=1))]]
    while len(begin) < count:
        reach = np.min([np.linalg.norm(points - one, axis=1) for one in begin], axis=0)
        begin.append(points[int(reach.argmax())])
    return _settled(points, np.array(begin))


def _settled(
    points: Float[np.ndarray, "n 2"], middles: Float[np.ndarray, "K 2"]
) -> Float[np.ndarray, "K 2"]:
    """Medians of the points nearest to each middle, in turns; a heap without points stays where it
    is.
    """
    before = middles
    for _ in range(ROUNDS):
        own = (
            np.linalg.norm(points[:, None] - middles, axis=2).argmin(axis=1)
            if len(points)
            else np.empty(0, int)
        )
        found = np.array(
            [
                np.median(points[own == k], axis=0) if (own == k).any() else m
                for k, m in enumerate(middles)
            ]
        )
        if np.array_equal(found, middles):
            break
        middles = found
    order = linear_sum_assignment(np.linalg.norm(before[:, None] - middles, axis=2))[1]
    return middles[order]
