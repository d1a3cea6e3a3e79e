"""Layout files written for the user: a draft from a capture's labels, or one estimated by a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.errors import shown
from habitus.fit.discover.result import Discovery
from habitus.io.layouts.toml import key_text, marker_line, quoted
from habitus.io.names import plain_name
from habitus.markers.checks import other_side
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.matching import interpreted

_HEADER = """\
# A marker layout for habitus: one line per marker, LABEL = "landmark" or
# LABEL = {{ place = "landmark", … }}. `habitus layout show --landmarks` lists the landmarks;
# docs/adding-a-marker-layout.md describes the format.
# {known} of {count} labels of {capture} are filled in, most as in {source}: check each.
# The others are TODO lines: remove the # and write the landmark that the marker sits on between the
# quotes, or delete the line to leave the marker out.
"""


def draft_layout(
    name: str,
    capture_name: str,
    labels: Sequence[str],
    markers: Float[np.ndarray, "T M 3"],
    known: Sequence[MarkerLayout],
) -> str:
    """The text of a layout file for these labels (M,) and markers (T, M, 3), metres, NaN missing.

    Labels that the ``known`` layouts understand as a set are filled in. Each other label is a
    commented line that says which known markers are nearest, so that a person finds its landmark.
    """
    labels = [plain_name(label) for label in labels]
    capture_name = plain_name(capture_name)
    meaning = interpreted(labels, known)
    by_label = {
        labels[column]: replace(marker, label=labels[column], aliases=(), optional=False)
        for column, marker in sorted(meaning.markers.items())
    }
    source = meaning.best.layout.name
    lines = [
        _HEADER.format(known=len(by_label), count=len(labels), capture=capture_name, source=source),
        f"name = {quoted(name)}",
        f"title = {quoted(f'Markers of {capture_name}')}",
        "",
        "[markers]",
        *_marker_lines(by_label),
    ]
    near = sorted(meaning.markers) if len(meaning.markers) >= 10 else list(range(len(labels)))
    for column, label in enumerate(labels):
        if column not in meaning.markers and label not in meaning.left_out:
            lines += _todo(
                column,
                labels,
                nearest_markers(markers, column, near),
                meaning.doubts.get(label, ""),
            )
    if meaning.left_out:
        lines += [
            "",
            "[left_out]",
            *(f"{key_text(label)} = {quoted(why)}" for label, why in meaning.left_out.items()),
        ]
    return "\n".join(lines) + "\n"


def _marker_lines(markers: dict[str, Marker]) -> list[str]:
    """One line a marker; a left one and its mirror image on one line with [LR]."""
    lines = []
    done = set()
    for label, marker in markers.items():
        pair = (
            "R" + label[1:] if label[:1] == "L" else "L" + label[1:] if label[:1] == "R" else None
        )
        mirror = markers.get(pair) if pair is not None else None
        if label in done:
            continue
        if mirror is None or replace(other_side(marker), label=mirror.label) != mirror:
            lines.append(marker_line(marker))
            continue
        done |= {label, mirror.label}
        left = marker if label[0] == "L" else mirror
        lines.append(marker_line(_both_sides(left)))
    return lines


def _both_sides(left: Marker) -> Marker:
    def both(name: str) -> str:
        return "[left|right]_" + name.removeprefix("left_") if name.startswith("left_") else name

    landmark = None if left.landmark is None else both(left.landmark)
    between = (
        None
        if left.between is None
        else (both(left.between[0]), both(left.between[1]), left.between[2])
    )
    return replace(left, label="[LR]" + left.label[1:], landmark=landmark, between=between)


def _todo(
    column: int, labels: Sequence[str], near: Sequence[tuple[int, float]], doubt: str
) -> list[str]:
    where = ", ".join(f"{distance * 1e3:.0f} mm from {labels[other]}" for other, distance in near)
    note = "; ".join(text for text in ("" if doubt == "unknown label" else doubt, where) if text)
    return [
        "",
        f"# TODO {labels[column]}{': ' + shown(note, 300) if note else ''}",
        f'# {key_text(labels[column])} = ""',
    ]


def nearest_markers(
    markers: Float[np.ndarray, "T M 3"], column: int, others: Sequence[int], count: int = 3
) -> list[tuple[int, float]]:
    """The columns nearest to a marker and their median distances, metres; those never seen with it
    are left out.
    """
    distances = []
    for other in others:
        spacing = np.linalg.norm(markers[:, other] - markers[:, column], axis=-1)
        seen = spacing[np.isfinite(spacing)]
        if other != column and len(seen):
            distances.append((other, float(np.median(seen))))
    return sorted(distances, key=lambda pair: pair[1])[:count]


_FOUND_HEADER = """\
# A marker layout that was estimated by fitting a body to {capture}. Placements are usually within
# 5 cm, on hands and along limbs within 10 cm; a confidence is the probability that the marker is
# within 5 cm of its placement. Check report.html, correct what is wrong
# (`habitus layout show --landmarks` lists the landmarks), and fit again with --layout FILE.
"""


def discovered_layout_text(discovery: Discovery, capture_name: str) -> str:
    """The text of a layout file: the least sure markers first, each with the labels that keep their
    distance to it.
    """
    name = plain_name(capture_name)
    layout = discovery.layout
    lines = [
        _FOUND_HEADER.format(capture=name),
        *(f"# NOT SURE: {shown(doubt, 300)}" for doubt in discovery.doubts),
        f"name = {quoted(f'discovered in {name}')}",
        f"title = {quoted(f'Discovered by fitting a body to {name}')}",
        *([] if layout.num_vertices is None else [f"num_vertices = {layout.num_vertices}"]),
        "",
        "[markers]",
    ]
    for marker in sorted(
        layout.markers, key=lambda one: 1.0 if one.confidence is None else one.confidence
    ):
        mates = discovery.companions.get(marker.label, ())
        note = (
            f"  # keeps its distance to {', '.join(plain_name(mate) for mate in mates)}"
            if mates
            else ""
        )
        lines.append(marker_line(marker) + note)
    if discovery.left_out:
        lines += [
            "",
            "[left_out]",
            *(f"{key_text(label)} = {quoted(why)}" for label, why in discovery.left_out.items()),
        ]
    return "\n".join(lines) + "\n"
