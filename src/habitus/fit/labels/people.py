"""Points of several people in one volume: clustered on the ground before they are labelled, and
once more by the fitted bodies.

In each frame the points' places on the ground fall into one cluster a person, tracked from frame to
frame, and a tracklet belongs to the cluster that it is nearest to on average. An arm that reaches
over another person is wrong then; so when each person's body is known, every tracklet goes to the
body whose markers pass nearest to it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.settings import PEOPLE, PeopleSettings
from habitus.fit.labels.votes import averaged, distances


def people_on_ground(
    clouds: Clouds,
    tracklet: Int[np.ndarray, " P"],
    count: int,
    settings: PeopleSettings = PEOPLE,
) -> Int[np.ndarray, " P"]:
    """The person, 0 to ``count`` - 1, of each point, by where people stand."""
    up = "xyz".index(clouds.up_axis[1])
    ground = np.delete(clouds.points, up, axis=1)
    centres = _tracked(ground, clouds.start, count, settings)
    squared = np.sum((ground[:, None] - centres[clouds.frame]) ** 2, axis=2)
    return averaged(squared, tracklet).argmin(axis=1)


def nearest_bodies(
    clouds: Clouds, tracklet: Int[np.ndarray, " P"], predicted: Sequence[Float[np.ndarray, "T _ 3"]]
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


def _tracked(
    ground: Float[np.ndarray, "P 2"],
    start: Int[np.ndarray, " T1"],
    count: int,
    settings: PeopleSettings,
) -> Float[np.ndarray, "T K 2"]:
    """Cluster centres in every frame, tracked in both directions from the frame with the best
    separated clusters.
    """
    frames = len(start) - 1
    sizes = np.diff(start)
    full = np.flatnonzero(sizes >= count)[:: max(1, frames // settings.start_frames)]
    first, centres = max(
        ((t, _clustered(ground[start[t] : start[t + 1]], count, settings)) for t in full),
        key=_separation,
    )
    out = np.empty((frames, count, 2))
    for direction in (range(first, frames), range(first, -1, -1)):
        here = centres
        for t in direction:
            here = _converged(ground[start[t] : start[t + 1]], here, settings)
            out[t] = here
    return out


def _separation(candidate: tuple[int, np.ndarray]) -> float:
    """The smallest distance between two cluster centres."""
    centres = candidate[1]
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    return float(distance[~np.eye(len(centres), dtype=bool)].min(initial=np.inf))


def _clustered(
    points: Float[np.ndarray, "n 2"], count: int, settings: PeopleSettings
) -> Float[np.ndarray, "K 2"]:
    """Cluster centres of one frame, begun at points far from each other."""
    begin = [np.median(points, axis=0)]
    begin = [points[np.argmax(np.linalg.norm(points - begin[0], axis=1))]]
    while len(begin) < count:
        distance = np.min([np.linalg.norm(points - centre, axis=1) for centre in begin], axis=0)
        begin.append(points[int(distance.argmax())])
    return _converged(points, np.array(begin), settings)


def _converged(
    points: Float[np.ndarray, "n 2"], centres: Float[np.ndarray, "K 2"], settings: PeopleSettings
) -> Float[np.ndarray, "K 2"]:
    """k-medians: medians of the points nearest to each centre, in turns; a cluster without points
    stays where it is.
    """
    before = centres
    for _ in range(settings.rounds):
        nearest = (
            np.linalg.norm(points[:, None] - centres, axis=2).argmin(axis=1)
            if len(points)
            else np.empty(0, int)
        )
        medians = np.array(
            [
                np.median(points[nearest == k], axis=0) if (nearest == k).any() else centre
                for k, centre in enumerate(centres)
            ]
        )
        if np.array_equal(medians, centres):
            break
        centres = medians
    order = linear_sum_assignment(np.linalg.norm(before[:, None] - centres, axis=2))[1]
    return centres[order]
