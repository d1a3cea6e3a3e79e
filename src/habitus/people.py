"""Captures grouped by person and brought to one marker layout."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from habitus.errors import HabitusError
from habitus.fit.mosh import Recording
from habitus.io.captures import Capture
from habitus.io.layouts import load_layout, match_layout
from habitus.observe.layout_match import LayoutMatch
from habitus.observe.layouts import MarkerLayout


@dataclass(frozen=True)
class Person:
    """One person's captures, brought to one layout: recordings share the layout's markers, in its order."""

    captures: tuple[Capture, ...]
    layout: MarkerLayout
    recordings: tuple[Recording, ...]


def gather(files: Sequence[Sequence[Capture]], layout: str | os.PathLike[str], subject: str | None) -> list[Person]:
    """Captures grouped by person: one person a file means one subject in all; else each named person is one."""
    found = [capture for file in files for capture in file]
    if subject is not None:
        chosen = [capture for capture in found if (capture.subject or "").lower() == subject.lower()]
        if not chosen:
            names = sorted({capture.subject or "(unnamed)" for capture in found})
            raise HabitusError(f"no capture holds a subject called {subject!r}; found {', '.join(names)}")
        return [_person(chosen, layout)]
    if all(len(file) == 1 for file in files):
        return [_person(found, layout)]
    names = list(dict.fromkeys(capture.subject for capture in found))
    return [_person([capture for capture in found if capture.subject == name], layout) for name in names]


def _person(captures: Sequence[Capture], layout: str | os.PathLike[str]) -> Person:
    """All captures of a person on the union of their matched markers."""
    given = None if os.fspath(layout) == "auto" else [load_layout(layout)]
    matches = [match_layout(capture.labels, capture.markers, layouts=given) for capture in captures]
    markers = {marker.label: marker for match in reversed(matches) for marker in match.layout.markers}
    union = replace(matches[0].layout, markers=tuple(markers.values()))
    recordings = []
    for capture, match in zip(captures, matches, strict=True):
        observed = np.full((len(capture.markers), len(union), 3), np.nan)
        columns = [union.labels.index(label) for label in match.layout.labels]
        observed[:, columns] = capture.markers[:, match.columns]
        notes = (*capture.warnings, _matched(match), *match.warnings)
        recordings.append(Recording(capture.name, observed, capture.rate_hz, capture.up_axis, notes))
    return Person(tuple(captures), union, tuple(recordings))


def _matched(match: LayoutMatch) -> str:
    words = f"layout {match.layout.name}: {len(match.matched)} labels matched, confidence {match.confidence:.2f}"
    if match.unmatched_labels:
        words += f"; not used: {', '.join(match.unmatched_labels)}"
    if match.missing_labels:
        words += f"; not in the capture: {', '.join(match.missing_labels)}"
    return words
