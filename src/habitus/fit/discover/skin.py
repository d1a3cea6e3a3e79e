"""Where on a body a marker may sit, places spread over its skin, and what is known of places before
anything is fitted: what some labels usually mean, and where layouts have markers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.discover.settings import DISCOVER, SkinSettings
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.mesh.normals import vertex_normals
from habitus.observe.marker_prediction import MarkedBody, marked_body
from habitus.observe.markers import attach, default_markers

_FINGERS = ("_pip", "_dip", "_tip", "_ip")
_ARM = ("hand", "wrist", "index", "middle", "ring", "pinky", "thumb", "elbow", "forearm")


@dataclass(frozen=True)
class Skin:
    """K places on a body's skin: their vertices (K,), where they lie on the template (K, 3), each
    one's place on the other side of the body, or the nearest there is (K,), and the distance (m) of
    markers from the skin.
    """

    vertices: Int[np.ndarray, " K"]
    points: Float[np.ndarray, "K 3"]
    across: Int[np.ndarray, " K"]
    distance: float

    def on(self, body: BodyModel, betas: Float[np.ndarray, " B"]) -> MarkedBody:
        """A body of shape ``betas`` that carries a marker at every place."""
        distances = np.full(len(self.vertices), self.distance)
        markers = default_markers(body, betas, self.vertices, distances)
        return marked_body(body, betas, attach(markers, body.rest_vertices(betas), body.faces))


def spread_places(body: BodyModel, count: int, settings: SkinSettings = DISCOVER.skin) -> Skin:
    """``count`` places as far apart as can be (farthest points of the template); fingers and soles
    have none.
    """
    template = np.asarray(body.v_template, dtype=float)
    usable = np.flatnonzero(wearable(body, settings))
    points = template[usable]
    chosen = [int(np.argmax(points[:, 1]))]
    nearest = np.full(len(points), np.inf)
    for _ in range(min(count, len(points)) - 1):
        nearest = np.minimum(nearest, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
        chosen.append(int(np.argmax(nearest)))
    vertices = np.sort(usable[chosen])
    points = template[vertices]
    mirrored = points * np.array([-1.0, 1.0, 1.0])
    across = np.argmin(np.sum((mirrored[:, None] - points[None]) ** 2, axis=2), axis=1)
    return Skin(vertices, points, across, settings.distance)


def wearable(body: BodyModel, settings: SkinSettings = DISCOVER.skin) -> Bool[np.ndarray, " V"]:
    """Whether a marker may sit on a vertex: not on fingers, whose bending few sets tell, nor on
    soles.
    """
    template = np.asarray(body.v_template, dtype=float)
    normals = vertex_normals(template, body.faces, np.arange(len(template)))
    above = template[:, 1] > template[:, 1].min() + settings.sole_height
    free = above | (normals[:, 1] > settings.sole_normal)
    names = [name for name in body.landmarks if any(part in name for part in _ARM)]
    fingers = np.array([name.endswith(_FINGERS) for name in names])
    if fingers.any():
        places = template[[int(body.landmarks[name]) for name in names]]
        away = np.sum((template[:, None] - places[None]) ** 2, axis=2)
        free &= ~(fingers[np.argmin(away, axis=1)] & (away.min(axis=1) < settings.finger**2))
    return free


def betas_of_height(body: BodyModel, height: float) -> Float[np.ndarray, " B"]:
    """The likeliest betas of a body that is ``height`` metres tall."""
    template = np.asarray(body.v_template, dtype=float)
    directions = np.asarray(body.shapedirs, dtype=float)
    top = int(np.argmax(template[:, 1]))
    bottom = int(np.argmin(template[:, 1]))
    slope = directions[top, 1] - directions[bottom, 1]
    squared = float(slope @ slope)
    return (
        slope * (height - (template[top, 1] - template[bottom, 1])) / squared
        if squared > 0
        else np.zeros(len(slope))
    )


def known_places(
    body: BodyModel,
    skin: Skin,
    labels: Sequence[str],
    known: Mapping[str, Marker] | None,
    settings: SkinSettings = DISCOVER.skin,
) -> Float[np.ndarray, "M K"]:
    """Logarithms of how likely labels are at places, from what known ones usually mean; 0 for the
    others.
    """
    likely = np.zeros((len(labels), len(skin.vertices)))
    rows = [k for k, label in enumerate(labels) if known and label in known]
    if known and rows:
        named = MarkerLayout(
            "known", tuple(replace(known[labels[k]], label=labels[k]) for k in rows)
        )
        away = _squared(body, skin, named)
        away -= away.min(axis=1, keepdims=True)
        near = np.exp(-away / (2.0 * settings.known_spread**2))
        likely[rows] = np.log(settings.stray + (1.0 - settings.stray) * near)
    return likely


def popularity(
    body: BodyModel,
    skin: Skin,
    usual: Sequence[MarkerLayout],
    settings: SkinSettings = DISCOVER.skin,
) -> Float[np.ndarray, " K"]:
    """Logarithms of how much likelier a marker is at each place than where no layout has one; 0
    without layouts.
    """
    total = np.zeros(len(skin.vertices))
    count = 0
    for layout in usual:
        try:
            near = np.exp(-_squared(body, skin, layout) / (2.0 * settings.layout_spread**2))
        except HabitusError:  # made for another body
            continue
        total = total + near.max(axis=0)
        count = count + 1
    return np.log1p(settings.popularity * total / max(count, 1))


def _squared(body: BodyModel, skin: Skin, layout: MarkerLayout) -> Float[np.ndarray, "M K"]:
    points = np.asarray(body.v_template, dtype=float)[layout.vertices(body)]
    return np.sum((skin.points[None] - points[:, None]) ** 2, axis=2)
