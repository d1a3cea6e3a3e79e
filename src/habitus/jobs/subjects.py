"""Captures grouped by person and brought to one marker layout: given, matched by labels, or
discovered by fitting.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError, listed
from habitus.fit.markers.hold_out import HeldMarkers
from habitus.fit.markers.recipe import Recording
from habitus.fit.markers.recordings import check_recordings
from habitus.fit.markers.suspects import Suspect
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout, match_layout, match_layouts, shipped_layouts
from habitus.markers.checks import MIRRORED
from habitus.markers.layouts import ON_A_FINGER, Marker, MarkerLayout
from habitus.markers.matching import LayoutMatch, interpreted
from habitus.parallel.blocks import mapped
from habitus.types import PathLike, Progress

if TYPE_CHECKING:
    from habitus.fit.discover.result import Discovery

LayoutChoice = PathLike | MarkerLayout | Sequence[MarkerLayout]
"""A layout that is asked for: "auto", "discover", a shipped name, a file, the layout itself, or
some to choose from.
"""


@dataclass(frozen=True)
class Person:
    """One person's captures, brought to one layout: recordings share the layout's markers, in its
    order.

    ``layout_choice``: the layout asked for; ``discovery``: how an unknown layout was estimated.
    ``fingers``: whether markers on fingers count; ``left_fingers`` are those that were left out.
    """

    captures: tuple[Capture, ...]
    layout_choice: LayoutChoice
    layout: MarkerLayout
    recordings: tuple[Recording, ...]
    fingers: bool = False
    left_fingers: tuple[str, ...] = ()
    discovery: "Discovery | None" = None


def gather(
    files: Sequence[Sequence[Capture]],
    layout: LayoutChoice,
    subject: str | None,
    body: BodyModel | None = None,
    progress: Progress = lambda stage, share: None,
) -> list[Person]:
    """Captures grouped by person: one person a file means one subject in all; else each named
    person is one.

    body: of that kind is who is fitted where the layout is to be discovered.
    """
    return [subject_of(each, layout, body, progress) for each in _people(files, subject)]


def subject_of(
    captures: Sequence[Capture], layout: LayoutChoice, body: BodyModel | None, progress: Progress
) -> Person:
    """`person`, whose layout is found by fitting a body first where that is asked for."""
    if not asks_to_discover(layout):
        return person_of(captures, layout)
    discovery = discovered(captures, body, progress)
    return replace(
        person_of(captures, discovery.layout, notes=discovery.notes, doubts=discovery.doubts),
        discovery=discovery,
    )


def _people(files: Sequence[Sequence[Capture]], subject: str | None) -> list[list[Capture]]:
    captures = [capture for file in files for capture in file]
    if subject is not None:
        chosen = [
            capture for capture in captures if (capture.subject or "").lower() == subject.lower()
        ]
        if not chosen:
            names = sorted({capture.subject or "(unnamed)" for capture in captures})
            raise HabitusError(
                f"no capture holds a subject called {subject!r}; found {', '.join(names)}"
            )
        return [chosen]
    if all(len(file) == 1 for file in files):
        return [captures]
    names = list(dict.fromkeys(capture.subject for capture in captures))
    return [[capture for capture in captures if capture.subject == name] for name in names]


def person_of(
    captures: Sequence[Capture],
    choice: LayoutChoice,
    fingers: bool = False,
    notes: Sequence[str] = (),
    doubts: tuple[str, ...] = (),
) -> Person:
    """All captures of a person on the union of their matched markers, those on fingers left out
    unless asked for.

    notes, doubts: what each recording is told besides.
    """
    matches = _checked(captures, choice, fingers)
    union = _union(matches)
    recordings = []
    for capture, match in zip(captures, matches, strict=True):
        warnings = (*capture.warnings, _matched(match), *notes, *match.warnings)
        markers = _on(union, match, capture)
        suspects = _suspects(match, len(markers))
        known = {
            "recorded": dict(capture.recorded),
            "layout_confidence": _confidence(match),
            "doubts": (*capture.doubts, *_mirrored(match), *doubts),
        }
        recordings.append(
            Recording(
                capture.name, markers, capture.rate_hz, capture.up_axis, warnings, suspects, **known
            )
        )
    left = dict.fromkeys(
        label for match in matches for label, why in match.left_out.items() if why == ON_A_FINGER
    )
    return Person(tuple(captures), choice, union, tuple(recordings), fingers, tuple(left))


@dataclass(frozen=True)
class Agreed:
    """What a person's captures told together, for captures of the same person that come later: the
    layout, how sure it is, and what is said of every capture.
    """

    layout: MarkerLayout
    confidence: float | None = None
    warnings: tuple[str, ...] = ()
    suspects: tuple[Suspect, ...] = ()
    doubts: tuple[str, ...] = ()

    @staticmethod
    def of(person: Person) -> "Agreed":
        """By all of a person's recordings: warnings and corrected places that all of them share."""
        first = person.recordings[0]
        others = person.recordings[1:]
        own = {_matched_words(recording) for recording in person.recordings}
        warnings = [
            text
            for text in first.warnings
            if text not in own and all(text in r.warnings for r in others)
        ]
        shared = [
            s for s in first.suspects if all(_reasons(r.suspects) >= _reasons([s]) for r in others)
        ]
        return Agreed(
            person.layout, first.layout_confidence, tuple(warnings), tuple(shared), first.doubts
        )

    def recording(self, capture: Capture) -> Recording:
        """One more capture in the layout's order, its own labels looked at for pairs that change
        places; the layout's places stay as they are. Raises HabitusError where too few labels are
        known.
        """
        match = _checked([capture], self.layout)[0]
        placed = {each.text for each in match.corrections if each.exchange is None}
        match = replace(
            match,
            corrections=tuple(each for each in match.corrections if each.exchange is not None),
        )
        names = tuple(marker.aliases[0] for marker in match.layout.markers)
        known = replace(match.layout, markers=tuple(self.layout[name] for name in names))
        match = replace(match, layout=known)
        own = [text for text in match.warnings if text not in placed]
        warnings = dict.fromkeys((*capture.warnings, _matched(match), *self.warnings, *own))
        suspects = _suspects(match, len(capture))
        common = [
            each for each in self.suspects if (each.label, each.reason) not in _reasons(suspects)
        ]
        common = [replace(each, frames=len(capture)) for each in common if each.label in names]
        return Recording(
            capture.name,
            _on(self.layout, match, capture),
            capture.rate_hz,
            capture.up_axis,
            tuple(warnings),
            (*suspects, *common),
            recorded=dict(capture.recorded),
            layout_confidence=self.confidence,
            doubts=tuple(dict.fromkeys((*capture.doubts, *self.doubts))),
        )


def _mirrored(match: LayoutMatch) -> tuple[str, ...]:
    """That sides were exchanged and need not have been, where they were."""
    if all(correction.check != MIRRORED for correction in match.corrections):
        return ()
    return (
        "Either left and right labels are exchanged throughout, or the capture is mirrored "
        "(left-handed axes): labels were exchanged back; if the capture is mirrored, so are the "
        "person and the motion.",
    )


def _reasons(suspects: Sequence[Suspect]) -> set[tuple[str, str]]:
    return {(suspect.label, suspect.reason) for suspect in suspects}


def _matched_words(recording: Recording) -> str:
    return next((text for text in recording.warnings if text.startswith("layout ")), "")


def _confidence(match: LayoutMatch) -> float:
    """How sure the layout is: of its choice, and of its places where these were found by
    fitting.
    """
    sure = [marker.confidence for marker in match.layout.markers if marker.confidence is not None]
    return min(match.confidence, float(np.mean(sure))) if sure else match.confidence


def check_each(person: Person) -> None:
    """HabitusError where one of the captures holds too few known markers in every frame, whatever
    the others hold.
    """
    for recording in person.recordings:
        check_recordings([recording])


def leave_out(whole: Person, labels: Sequence[str]) -> tuple[Person, HeldMarkers]:
    """The person without some markers, and those markers with their observations.

    The layout is matched afresh without them, so that nothing of them decides where anything sits;
    their own places come from labels alone. Labels that the file itself exchanges are first put
    right, for both sides alike: they are the file's fault, not a place. Raises HabitusError for a
    label that was not matched.
    """
    unknown = sorted(set(labels) - set(whole.layout.labels))
    if unknown:
        raise HabitusError(
            f"cannot hold out {', '.join(unknown)}: not among the matched labels "
            f"{', '.join(whole.layout.labels)}"
        )
    if set(labels) >= set(whole.layout.labels):
        raise HabitusError(
            f"cannot hold out all {len(whole.layout)} markers; leave some to fit the body to"
        )
    captures = relabelled(whole)
    kept = person_of(
        [_only(capture, [x for x in capture.labels if x not in labels]) for capture in captures],
        whole.layout_choice,
        whole.fingers,
    )
    layouts = _given(whole.layout_choice, whole.fingers)
    matches = [match_layout(capture.labels, layouts=layouts) for capture in captures]
    union = _union(matches)
    gone = union.restricted_to(tuple(label for label in union.labels if label in labels))
    stay = union.restricted_to(tuple(label for label in union.labels if label not in labels))
    columns = [union.labels.index(label) for label in gone.labels]
    observed = tuple(
        _on(union, match, capture)[:, columns]
        for match, capture in zip(matches, captures, strict=True)
    )
    return kept, HeldMarkers(gone, observed, stay)


def relabelled(whole: Person) -> list[Capture]:
    """A person's captures with exchanged labels put back, whether for a while or throughout."""
    captures = []
    again = _checked(whole.captures, whole.layout_choice, whole.fingers)
    for capture, checked in zip(whole.captures, again, strict=True):
        plain = match_layout(
            capture.labels, layouts=_given(whole.layout_choice, whole.fingers)
        ).layout
        markers = np.array(capture.markers)
        markers[:, checked.columns] = checked.select(capture.markers)
        renamed = dict(_exchanged(plain, checked.layout))
        captures.append(
            replace(
                capture, labels=tuple(renamed.get(x, x) for x in capture.labels), markers=markers
            )
        )
    return captures


def _exchanged(plain: MarkerLayout, checked: MarkerLayout) -> Iterator[tuple[str, str]]:
    """Pairs of labels, both ways round, that sit at each other's places once the geometry has been
    looked at.
    """
    places = {marker.label: marker.place for marker in plain.markers}
    checked_places = {marker.label: marker.place for marker in checked.markers}
    for a in checked_places:
        for b in checked_places:
            if (
                a != b
                and places.get(a) != places.get(b)
                and (checked_places[a], checked_places[b]) == (places.get(b), places.get(a))
            ):
                yield a, b


def _checked(
    captures: Sequence[Capture], choice: LayoutChoice, fingers: bool = False
) -> Sequence[LayoutMatch]:
    """The captures matched by labels and geometry, judged together."""
    layouts = _given(choice, fingers)
    try:
        return match_layouts(
            [(capture.labels, capture.markers) for capture in captures], layouts=layouts
        )
    except HabitusError as error:
        raise HabitusError(f"{', '.join(capture.name for capture in captures)}: {error}") from error


def _given(choice: LayoutChoice, fingers: bool = False) -> list[MarkerLayout] | None:
    if isinstance(choice, MarkerLayout):
        layouts = [choice]
    elif not isinstance(choice, str | os.PathLike):
        layouts = list(choice)
    elif os.fspath(choice) != "auto":
        layouts = [load_layout(choice)]
    elif not fingers:
        return None
    else:
        layouts = list(shipped_layouts())
    return [layout.with_fingers() for layout in layouts] if fingers else layouts


def _union(matches: Sequence[LayoutMatch]) -> MarkerLayout:
    markers = {
        marker.label: marker for match in reversed(matches) for marker in match.layout.markers
    }
    return replace(matches[0].layout, markers=tuple(markers.values()))


def _on(layout: MarkerLayout, match: LayoutMatch, capture: Capture) -> np.ndarray:
    """The capture's markers (T, M, 3) in the layout's order, NaN where it lacks one."""
    columns = [layout.labels.index(label) for label in match.layout.labels]

    def spread(markers: np.ndarray) -> np.ndarray:
        observed = np.full((len(markers), len(layout), 3), np.nan)
        observed[:, columns] = markers
        return observed

    return mapped(spread, match.select(capture.markers))


def _suspects(match: LayoutMatch, frames: int) -> tuple[Suspect, ...]:
    """Markers whose labels or places the capture's geometry put right."""
    suspects = []
    for correction in match.corrections:
        if correction.exchange is not None:
            pair = [
                match.layout.labels[k]
                for k in (correction.exchange.first, correction.exchange.second)
            ]
            count = int(correction.exchange.frames.sum())
            suspects += [
                Suspect(a, f"swapped with {b}; exchanged back", count, True)
                for a, b in (pair, pair[::-1])
            ]
        elif not correction.quiet:
            suspects += [
                Suspect(marker.label, correction.text, frames, True)
                for marker in correction.markers
            ]
    return tuple(suspects)


def _only(capture: Capture, labels: Sequence[str]) -> Capture:
    columns = [capture.labels.index(label) for label in labels]
    return replace(capture, labels=tuple(labels), markers=capture.markers[:, columns])


def _matched(match: LayoutMatch) -> str:
    words = (
        f"layout {match.layout.name}: {len(match.matched)} labels matched, confidence "
        f"{match.confidence:.2f}"
    )
    if match.unmatched_labels:
        words += f"; not used: {listed(match.unmatched_labels)}"
    if match.missing_labels:
        words += f"; not in the capture: {listed(match.missing_labels)}"
    return words


DISCOVER = "discover"
_FRAMES = 2000  # of each capture that are looked at


def asks_to_discover(layout: object) -> bool:
    """Whether a layout that is asked for is to be found by fitting."""
    return isinstance(layout, str) and layout == DISCOVER


def check_layout(
    layout: LayoutChoice, hold_out: Sequence[str] = (), every: int | None = None
) -> None:
    """Raises HabitusError for a layout that is neither there nor to be found, and where markers are
    to be held out that would determine their own places.
    """
    if isinstance(layout, str | os.PathLike) and str(layout) not in ("auto", DISCOVER):
        load_layout(layout)
    if asks_to_discover(layout) and (hold_out or every is not None):
        raise HabitusError(
            "markers cannot be held out where their places are discovered, since each determines "
            "its own place; fit again with the layout.toml of the discovery"
        )


def discovered(
    captures: Sequence[Capture], body: BodyModel | None, progress: Progress
) -> "Discovery":
    """The layout of all captures of a person together; labels that known layouts understand as a
    set help.

    Raises HabitusError, naming the captures, where there are too few labels.
    """
    from habitus.fit.discover.recipe import discover

    assert body is not None
    labels = tuple(dict.fromkeys(label for capture in captures for label in capture.labels))
    markers = np.concatenate([_some_frames(capture, labels) for capture in captures])
    try:
        known = known_labels(labels, body)
        usual = shipped_layouts()
        return discover(body, prior_of(body), labels, markers, known, usual, progress)
    except HabitusError as error:
        raise HabitusError(f"{', '.join(capture.name for capture in captures)}: {error}") from error


def known_labels(labels: Sequence[str], body: BodyModel) -> dict[str, Marker]:
    """What some labels usually mean, by the layout that explains most of them and where others
    agree; on this body.
    """
    meanings = interpreted(labels, shipped_layouts()).markers
    return {
        labels[column]: marker
        for column, marker in meanings.items()
        if set(marker.landmarks) <= set(body.landmarks)
    }


def _some_frames(capture: Capture, labels: Sequence[str]) -> np.ndarray:
    """(T, M, 3) evenly chosen frames with a column for each label, NaN where the capture lacks
    it.
    """
    step = max(1, -(-len(capture.markers) // _FRAMES))
    some = np.asarray(capture.markers[::step], dtype=float)
    markers = np.full((len(some), len(labels), 3), np.nan)
    markers[:, [labels.index(label) for label in capture.labels]] = some
    return markers
