"""Places in words: the landmark, or the point between two landmarks, that is nearest to a
vertex.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.markers.layouts import Marker, MarkerLayout, PlacedBody

AT = 0.012
"""Metres: a vertex this near to a landmark is the landmark."""
_SHARES = np.round(np.linspace(0.05, 0.95, 19), 2)
_MIDDLE = 0.03  # metres: nearer to x = 0 than this, landmarks of both sides may be meant
_LONGEST = 0.45
_TRIED = 24  # metres between two landmarks; pairs looked at
_LENGTH = 0.04  # so much nearer must a point be for each metre that its landmarks are further apart


def place_in_words(body: PlacedBody, vertex: int) -> Marker:
    """A marker without a label at a vertex, said by landmarks, so that people can read and correct
    it; by the vertex where the body has no landmarks.
    """
    template = np.asarray(body.v_template, dtype=float)
    names = [name for name in body.landmarks if _sided_as(name, template[vertex])]
    if len(names) < 2:
        return Marker("", vertex=int(vertex))
    points = template[[int(body.landmarks[name]) for name in names]]
    away = np.linalg.norm(points - template[vertex], axis=1)
    nearest = int(np.argmin(away))
    if away[nearest] <= AT:
        return Marker("", landmark=names[nearest])
    found = [Marker("", landmark=names[nearest]), *_between(names, points, template[vertex])]
    unique = MarkerLayout("", tuple(Marker(str(k), **_place(one)) for k, one in enumerate(found)))
    off = np.linalg.norm(template[unique.vertices(body)] - template[vertex], axis=1)
    far = np.array([0.0, *(_apart(one, body) for one in found[1:])])
    return found[int(np.argmin(off + _LENGTH * far))]


def _between(
    names: Sequence[str], points: Float[np.ndarray, "L 3"], target: Float[np.ndarray, " 3"]
) -> list[Marker]:
    """Points between two landmarks that are near to a target, the nearest first."""
    first, second = (np.asarray(rows) for rows in np.triu_indices(len(names), 1))
    near = np.linalg.norm(points[first] - points[second], axis=1) < _LONGEST
    first = first[near]
    second = second[near]
    way = points[second] - points[first]
    at = points[first][:, None] + _SHARES[None, :, None] * way[:, None]
    off = np.linalg.norm(at - target, axis=2) + _LENGTH * np.linalg.norm(way, axis=1)[:, None]
    best = np.argmin(off, axis=1)
    order = np.argsort(off[np.arange(len(best)), best], kind="stable")[:_TRIED]
    return [
        Marker("", between=(names[int(first[k])], names[int(second[k])], float(_SHARES[best[k]])))
        for k in order
    ]


def _apart(marker: Marker, body: PlacedBody) -> float:
    ends = np.asarray(body.v_template)[[int(body.landmarks[name]) for name in marker.landmarks]]
    return float(np.linalg.norm(ends[0] - ends[1]))


def _place(marker: Marker) -> dict:
    return {"landmark": marker.landmark, "between": marker.between}


def _sided_as(name: str, point: Float[np.ndarray, " 3"]) -> bool:
    """Whether a landmark is not on the other side of the body than a point."""
    other = "right_" if point[0] > _MIDDLE else "left_" if point[0] < -_MIDDLE else None
    return other is None or not name.startswith(other)
