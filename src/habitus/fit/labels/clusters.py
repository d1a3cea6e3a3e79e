"""Markers that a layout has at one place: which is called what nobody can tell, but each is
followed by where it sits.

A gait lab tapes plates of three or four markers to thighs and shanks, and a layout knows little
more than where the plate is. Seeds name such markers at random. So the points of a plate are taken
into the frame of the skin under it, where each marker stands still, and shared out anew: no two of
one frame to one marker, each near its own place.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from habitus.body.model import BodyModel
from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.settings import CLUSTERS, ClusterSettings
from habitus.fit.markers.energy import Placement
from habitus.observe.marker_prediction import MarkedBody, marked_body, predict
from habitus.observe.markers import MarkerAttachment


def clusters(placement: Placement) -> list[Int[np.ndarray, " _"]]:
    """The markers (two or more) of each place that a layout gives to several."""
    where = np.stack([placement.vertices, np.round(1e4 * placement.distance)], axis=1)
    place = np.unique(where, axis=0, return_inverse=True)[1].ravel()
    return [np.flatnonzero(place == k) for k in np.flatnonzero(np.bincount(place) > 1)]


def separated(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    attachment: MarkerAttachment,
    placement: Placement,
    clouds: Clouds,
    label: Int[np.ndarray, " P"],
    frames: Int[np.ndarray, " F"],
    state: tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F 3"]],
    settings: ClusterSettings = CLUSTERS,
) -> MarkerAttachment:
    """The attachment with the markers of each cluster where their points sit; others stay as they
    are.

    frames, state: poses in which points near a cluster, of its labels or of none, are looked at.
    """
    groups = clusters(placement)
    if not groups:
        return attachment
    triangles = attachment.triangles.copy()
    coefficients = attachment.coefficients.copy()
    nearest = _nearest_group(
        groups, marked_body(body, betas, attachment), clouds, label, frames, state, settings.reach
    )
    for g, members in enumerate(groups):
        carrier = triangles[members[0]]
        points = _points(body, betas, carrier, clouds, nearest == g, frames, state)
        places = _places(points, len(members), settings)
        if places is not None:
            triangles[members], coefficients[members] = carrier, places
    return MarkerAttachment(triangles, coefficients)


def _nearest_group(
    groups: list[np.ndarray],
    rig: MarkedBody,
    clouds: Clouds,
    label: np.ndarray,
    frames: np.ndarray,
    state: tuple[np.ndarray, np.ndarray],
    reach: float,
) -> Int[np.ndarray, " P"]:
    """The cluster that each point without another name is nearest to, within ``reach`` (m); -1 for
    none.
    """
    nearest = np.full(len(label), -1)
    free = np.isin(label, np.append(np.concatenate(groups), -1))
    predicted = predict(rig, *state)
    middles = np.stack([predicted[:, members].mean(axis=1) for members in groups], axis=1)
    for middle, t in zip(middles, frames, strict=True):
        rows = np.arange(int(clouds.start[t]), int(clouds.start[t + 1]))
        rows = rows[free[rows]]
        distance = np.linalg.norm(clouds.points[rows][:, None] - middle, axis=2)
        near = distance.min(axis=1, initial=np.inf) < reach
        nearest[rows] = np.where(near, distance.argmin(axis=1), -1)
    return nearest


def _points(
    body: BodyModel,
    betas: np.ndarray,
    carrier: np.ndarray,
    clouds: Clouds,
    chosen: np.ndarray,
    frames: np.ndarray,
    state: tuple[np.ndarray, np.ndarray],
) -> list[Float[np.ndarray, "_ 3"]]:
    """Of each frame the chosen points in the basis of a triangle of the posed body, metres."""
    tripod = MarkerAttachment(
        np.tile(carrier, (4, 1)), np.concatenate([np.zeros((1, 3)), np.eye(3)])
    )
    corners = predict(marked_body(body, betas, tripod), *state)
    local = []
    for (origin, *ends), t in zip(corners, frames, strict=True):
        rows = np.arange(int(clouds.start[t]), int(clouds.start[t + 1]))
        local.append((clouds.points[rows[chosen[rows]]] - origin) @ (np.array(ends) - origin).T)
    return local


def _places(
    points: list[Float[np.ndarray, "_ 3"]], count: int, settings: ClusterSettings
) -> Float[np.ndarray, "k 3"] | None:
    """Where ``count`` markers sit that gave these points, frame by frame; None where no frame shows
    them all.
    """
    full = [each for each in points if len(each) == count]
    if not full:
        return None
    starts = full[:: max(1, len(full) // settings.starts)][: settings.starts]
    tries = [_converged(start, points, settings.rounds) for start in starts]
    return min(tries, key=lambda each: each[0])[1]


def _converged(
    places: np.ndarray, points: list[np.ndarray], rounds: int
) -> tuple[float, Float[np.ndarray, "k 3"]]:
    """Cost and places: in turns points to markers, one to one in each frame, and places to medians
    of their points.
    """
    for _ in range(rounds):
        shared: list[list[np.ndarray]] = [[] for _ in places]
        cost = 0.0
        for each in points:
            distance = np.linalg.norm(places[:, None] - each[None], axis=2)
            rows, columns = linear_sum_assignment(distance)
            cost += float(distance[rows, columns].sum())
            for k, n in zip(rows.tolist(), columns.tolist(), strict=True):
                shared[k].append(each[n])
        before = places
        places = np.array(
            [np.median(own, axis=0) if own else places[k] for k, own in enumerate(shared)]
        )
        if np.array_equal(places, before):
            break
    return cost, places
