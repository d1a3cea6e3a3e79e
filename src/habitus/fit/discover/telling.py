"""What a discovery says: places in words, how sure they are, what is not decided, what else there
is to know.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import listed
from habitus.fit.discover.groups import companions
from habitus.fit.discover.places import OFF_SPREAD, Seated, within
from habitus.fit.discover.result import Discovery
from habitus.fit.discover.sides import agreement, named_sides
from habitus.fit.discover.skin import OFF_SKIN, Skin
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.places_in_words import place_in_words

DECIDED = 0.3
"""Of a reading's cost: the least by which every other reading of the capture must cost more."""
REACH = 0.05
"""Metres: a confidence is the chance that a marker sits within this of its place."""
PLACE_SPREAD = 0.04
# metres of mean error in the frames looked at: right readings left 1 to 6.6 mm on real captures
_POOR = 0.0075


def told(
    body: BodyModel,
    labels: Sequence[str],
    frames: Float[np.ndarray, "F M 3"],
    found: Seated,
    skin: Skin,
    margin: float | None,
    known: Mapping[str, Marker],
    left_out: Mapping[str, str],
) -> Discovery:
    """Step 4: the layout in words, and what is not decided."""
    template = np.asarray(body.v_template, dtype=float)
    sure = within(found, skin, template, REACH)
    undecided = margin is not None and margin < DECIDED
    across = template[found.vertices, 0]
    markers = tuple(
        replace(
            place_in_words(body, int(vertex)),
            label=label,
            distance=OFF_SKIN,
            distance_spread=OFF_SPREAD,
            place_spread=PLACE_SPREAD,
            confidence=round(float(confidence) * (0.5 if undecided else 1.0), 2),
        )
        for label, vertex, confidence in zip(labels, found.vertices, sure, strict=True)
    )
    mean = float(np.nanmean(found.errors))
    groups = {
        label: tuple(labels[k] for k in group)
        for label, group in zip(labels, companions(frames), strict=True)
        if group
    }
    named = agreement(named_sides(labels), across)
    doubts = (*_undecided(margin, named), *_contradicted(named, undecided), *_poor(mean))
    notes = tuple(_notes(body, labels, found, known, left_out))
    layout = MarkerLayout("discovered", markers, "Found by fitting", num_vertices=len(template))
    return Discovery(layout, left_out, doubts, notes, groups, margin, 1e3 * mean)


def _undecided(margin: float | None, named: float | None) -> list[str]:
    if margin is None or margin >= DECIDED:
        return []
    how = f"another reading of the capture costs only {100 * abs(margin):.0f} % more"
    if named is not None and named > 0.5:
        return [
            f"Left and right, or front and back, are taken from the labels' names: {how}; bending "
            "joints would tell."
        ]
    return [
        f"Left and right, or front and back, are not decided: {how}; a capture with bending "
        "joints would tell."
    ]


def _contradicted(named: float | None, undecided: bool) -> list[str]:
    if named is None or named > 0.5 or undecided:
        return []
    return [
        f"The labels' names say the other side for {100 * (1 - named):.0f} % of the markers: "
        "mirrored, or misnamed?"
    ]


def _poor(mean: float) -> list[str]:
    return (
        []
        if mean < _POOR
        else [f"The places found explain the markers poorly ({1e3 * mean:.0f} mm)."]
    )


def _notes(
    body: BodyModel,
    labels: Sequence[str],
    found: Seated,
    known: Mapping[str, Marker],
    left_out: Mapping[str, str],
) -> Iterator[str]:
    template = np.asarray(body.v_template, dtype=float)
    if left_out:
        yield "labels left out: " + listed(
            [f"{label} ({why})" for label, why in left_out.items()], 4, "; "
        )
    for label, vertex in zip(labels, found.vertices, strict=True):
        if label in known:
            usual = MarkerLayout("known", (replace(known[label], label=label),)).vertices(body)[0]
            away = float(np.linalg.norm(template[usual] - template[vertex]))
            if away > 2 * REACH:
                yield (
                    f"{label} usually means {known[label].place}; it was found {100 * away:.0f} "
                    "cm from there"
                )
