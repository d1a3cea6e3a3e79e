"""Where people put markers: what fits of many captures say of each named place, beside what layouts
say (M 4.1).

A layout's place is a landmark; a technician's is where the landmark feels to be, or where a belt, a
shoe or a wand puts the marker. The prior is of two levels: a place (``left_asis`` and
``right_asis`` are one, mirrored), and at that place a label, which is what sets of markers share.
Everything here is data; ``habitus.fit.placements`` learns it and ``habitus.io.layouts.files``
reads and writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from habitus.markers.layouts import DEFAULT_PLACE_SPREAD, Marker, MarkerLayout

LEFT = "left_"
RIGHT = "right_"
LEAST_DISTANCE = 5e-3
"""Metres: no marker's centre is nearer to the skin, whatever people's mean says."""
FREELY = 0.03
"""Metres: a place this unsure is one that hands choose freely."""
FAR = 0.12
"""Metres: a marker that is farther off was put at another place."""


@dataclass(frozen=True)
class UsualPlace:
    """Where people put a marker, beside the layout's place.

    shift: along the skin of the template, metres in body space (x away from the middle, y up, z
    ahead); off: added to the distance from the skin, as far as the layout is unsure of that;
    spread: standard deviation of one person's marker about it in every direction (m), for whoever
    asks: a layout keeps its own, by which markers that are placed freely are known. people: how
    many told it.
    """

    shift: tuple[float, float, float]
    off: float
    spread: float = DEFAULT_PLACE_SPREAD
    people: int = 0


@dataclass(frozen=True)
class PlacementPrior:
    """Usual places by the place's name without its side, and by that and a label without its side.

    alike: the share of what a person's marker is off its place that its twin on the other side is
    off too, of markers on landmarks, and of those that are placed freely along a limb.
    """

    places: Mapping[str, UsualPlace] = field(default_factory=dict)
    labels: Mapping[tuple[str, str], UsualPlace] = field(default_factory=dict)
    alike: tuple[float, float] = (0.0, 0.0)

    def usual(self, marker: Marker, key: str) -> UsualPlace | None:
        """What is known of a marker whose label without its side is ``key``: of the label here,
        else of the place.
        """
        place = sideless(marker.place)
        return self.labels.get((place, key), self.places.get(place))

    def applied(self, layout: MarkerLayout) -> MarkerLayout:
        """The layout with each marker where people put it. Places that the layout shifts itself
        stay as they are.
        """
        keys = label_keys(layout)
        return replace(layout, markers=tuple(self._moved(m, keys[m.label]) for m in layout.markers))

    def expected(
        self, known: MarkerLayout, offsets: Float[np.ndarray, "K 3"], layout: MarkerLayout
    ) -> Float[np.ndarray, "H 3"]:
        """How far off their places a person's markers are expected, whose ``known`` others were
        found off theirs.

        offsets and answer in metres in body space at rest. What hands did on one side they did on
        the other: a share of what the marker with the same label is off on the other side,
        mirrored. One that is farther off than `FAR` was put elsewhere, and tells nothing.
        """
        keys = label_keys(replace(known, markers=(*known.markers, *layout.markers)))
        near = [
            (m, offset)
            for m, offset in zip(known.markers, offsets, strict=True)
            if np.linalg.norm(offset) < FAR
        ]
        mirrored_offsets = {
            (sideless(m.place), keys[m.label]): mirrored(m, offset) for m, offset in near
        }
        twins = [
            mirrored_offsets.get((sideless(m.place), keys[m.label]), np.zeros(3))
            for m in layout.markers
        ]
        expected_places = [
            self.alike[is_free(m)] * mirrored(m, twin)
            for m, twin in zip(layout.markers, twins, strict=True)
        ]
        return np.array(expected_places).reshape(-1, 3)

    def _moved(self, marker: Marker, key: str) -> Marker:
        usual = self.usual(marker, key)
        if usual is None or marker.shift is not None or not marker.landmarks:
            return marker
        x, y, z = usual.shift
        off = float(np.clip(usual.off, -marker.distance_spread, marker.distance_spread))
        return replace(
            marker,
            shift=(outward(marker) * x, y, z),
            distance=max(marker.distance + off, min(marker.distance, LEAST_DISTANCE)),
        )


def sideless(place: str) -> str:
    """A place's name without its sides: ``left_asis`` and ``right_asis`` are ``asis``."""
    return place.replace(LEFT, "").replace(RIGHT, "")


def is_free(marker: Marker) -> bool:
    """Whether a marker is placed freely along a limb, not on a landmark."""
    return marker.place_spread >= FREELY


def mirrored(marker: Marker, offset: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """An offset in body space as one whose x is away from the middle of the body, or back."""
    return np.array([outward(marker), 1.0, 1.0]) * offset


def outward(marker: Marker) -> float:
    """1 where away from the middle of the body is +x, on the left and, say, on the middle; -1 on
    the right.
    """
    return -1.0 if marker.landmarks[:1] and marker.landmarks[0].startswith(RIGHT) else 1.0


def label_keys(layout: MarkerLayout) -> dict[str, str]:
    """Each label without its side: ``LFWT`` and ``RFWT`` are ``[LR]FWT``; a label without a twin is
    its own.
    """
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
