"""What is known of places before anything is fitted: what some labels usually mean, where people
put markers at all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.discover.skin import Skin
from habitus.markers.layouts import Marker, MarkerLayout

_KNOWN = 0.05
_STRAY = 0.02  # metres about a known label's place, and the chance that it is elsewhere
_ABOUT = 0.025  # metres about a place of a layout
_PULL = 8.0  # how many times likelier than any other is a place that all layouts have


def known_places(
    body: BodyModel, skin: Skin, labels: Sequence[str], known: Mapping[str, Marker] | None
) -> Float[np.ndarray, "M K"]:
    """Logarithms of how likely labels are at places, from what known ones usually mean; 0 for the
    others.
    """
    likely = np.zeros((len(labels), len(skin.vertices)))
    told = [k for k, label in enumerate(labels) if known and label in known]
    if known and told:
        named = MarkerLayout(
            "known", tuple(replace(known[labels[k]], label=labels[k]) for k in told)
        )
        away = _squared(body, skin, named)
        away -= away.min(axis=1, keepdims=True)
        likely[told] = np.log(_STRAY + (1.0 - _STRAY) * np.exp(-away / (2.0 * _KNOWN**2)))
    return likely


def popularity(
    body: BodyModel, skin: Skin, usual: Sequence[MarkerLayout]
) -> Float[np.ndarray, " K"]:
    """Logarithms of how much likelier a marker is at each place than where no layout has one; 0
    without layouts.
    """
    total = np.zeros(len(skin.vertices))
    count = 0
    for layout in usual:
        try:
            near = np.exp(-_squared(body, skin, layout) / (2.0 * _ABOUT**2))
        except HabitusError:  # made for another body
            continue
        total = total + near.max(axis=0)
        count = count + 1
    return np.log1p(_PULL * total / max(count, 1))


def _squared(body: BodyModel, skin: Skin, layout: MarkerLayout) -> Float[np.ndarray, "M K"]:
    points = np.asarray(body.v_template, dtype=float)[layout.vertices(body)]
    return np.sum((skin.points[None] - points[:, None]) ** 2, axis=2)
