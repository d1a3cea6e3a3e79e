"""Where people put markers: what fits of many captures say of each named place, beside what layouts say (M 4.1).

A layout's place is a landmark; a technician's is where the landmark feels to be, or where a belt, a shoe or a wand
puts the marker. The prior is of two levels: a place (``left_asis`` and ``right_asis`` are one, mirrored), and at that
place a label, which is what sets of markers share. Everything here is data; ``habitus.fit.placements`` learns it and
``habitus.io.layouts.placements`` reads and writes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from habitus.markers.layouts import Marker, MarkerLayout

LEFT, RIGHT = "left_", "right_"
LEAST_DISTANCE = 2e-3
"""Metres: no marker's centre is nearer to the skin, whatever people's mean says."""
FAR = 0.12
"""Metres: a marker that is farther off was put at another place."""


@dataclass(frozen=True)
class UsualPlace:
    """Where people put a marker, beside the layout's place.

    shift: along the skin of the template, metres in body space (x away from the middle, y up, z ahead); off: added to
    the distance from the skin; spread: standard deviation along the skin of one person's marker about it, None where
    too few people tell it. people: who told it.
    """

    shift: tuple[float, float, float]
    off: float
    spread: float | None = None
    people: int = 0


@dataclass(frozen=True)
class PlacementPrior:
    """Usual places by the place's name without its side, and by that and a label without its side.

    alike: the correlation of what one person's markers are off at one place: two with one label (left and right), and
    two with different labels.
    """

    places: Mapping[str, UsualPlace] = field(default_factory=dict)
    labels: Mapping[tuple[str, str], UsualPlace] = field(default_factory=dict)
    alike: tuple[float, float] = (0.0, 0.0)

    def usual(self, marker: Marker, key: str) -> UsualPlace | None:
        """What is known of a marker whose label without its side is ``key``: of the label here, else of the place."""
        place = sideless(marker.place)
        return self.labels.get((place, key), self.places.get(place))

    def applied(self, layout: MarkerLayout) -> MarkerLayout:
        """The layout with each marker where people put it. Places that the layout shifts itself stay as they are."""
        keys = label_keys(layout)
        return replace(layout, markers=tuple(self._moved(m, keys[m.label]) for m in layout.markers))

    def expected(
        self, known: MarkerLayout, offsets: Float[np.ndarray, "K 3"], layout: MarkerLayout
    ) -> Float[np.ndarray, "H 3"]:
        """How far off their places a person's markers are expected, whose ``known`` others were found off theirs.

        offsets and answer in metres in body space at rest. What the same hands did on one side they did on the other:
        the mean of a Gaussian given the others at the same place, those of both sides mirrored. Others that are farther
        off than `FAR` are elsewhere, and tell nothing.
        """
        near = np.linalg.norm(offsets, axis=1) < FAR
        offsets, markers = offsets[near], [m for m, here in zip(known.markers, near, strict=True) if here]
        both, count = replace(known, markers=(*markers, *layout.markers)), len(markers)
        keys = label_keys(both)
        places = np.array([sideless(marker.place) for marker in both.markers])
        names = np.array([keys[marker.label] for marker in both.markers])
        spread = np.array([layout_spread(marker) for marker in both.markers])
        mirror = np.array([(outward(marker), 1.0, 1.0) for marker in both.markers]).reshape(-1, 3)
        same = names[:, None] == names
        cov = np.where(same, self.alike[0], self.alike[1]) * (places[:, None] == places)
        np.fill_diagonal(cov, 1.0)
        cov = cov * np.outer(spread, spread)
        gain = np.linalg.solve(cov[:count, :count], cov[:count, count:]).T
        return mirror[count:] * (gain @ (mirror[:count] * offsets))

    def _moved(self, marker: Marker, key: str) -> Marker:
        usual = self.usual(marker, key)
        if usual is None or marker.shift is not None or not marker.landmarks:
            return marker
        x, y, z = usual.shift
        return replace(
            marker,
            shift=(outward(marker) * x, y, z),
            distance=max(marker.distance + usual.off, min(marker.distance, LEAST_DISTANCE)),
            place_spread=marker.place_spread if usual.spread is None else usual.spread,
        )


def sideless(place: str) -> str:
    """A place's name without its sides: ``left_asis`` and ``right_asis`` are ``asis``."""
    return place.replace(LEFT, "").replace(RIGHT, "")


def layout_spread(marker: Marker) -> float:
    """How unsure a layout is of a marker, on and off the skin together, metres."""
    return math.hypot(marker.place_spread, marker.distance_spread)


def outward(marker: Marker) -> float:
    """1 where away from the middle of the body is +x, on the left and, say, on the middle; -1 on the right."""
    return -1.0 if marker.landmarks[:1] and marker.landmarks[0].startswith(RIGHT) else 1.0


def label_keys(layout: MarkerLayout) -> dict[str, str]:
    """Each label without its side: ``LFWT`` and ``RFWT`` are ``[LR]FWT``; a label without a twin is its own."""
    labels = {marker.label: sideless(marker.place) for marker in layout.markers}
    return {label: _key(label, place, labels) for label, place in labels.items()}


def _key(label: str, place: str, places: Mapping[str, str]) -> str:
    for index, letter in enumerate(label):
        pair = next((pair for pair in ("LR", "lr") if letter in pair), None)
        if pair is not None:
            twin = label[:index] + pair[1 - pair.index(letter)] + label[index + 1 :]
            if places.get(twin) == place:
                return f"{label[:index]}[{pair}]{label[index + 1 :]}"
    return label
