"""From the points of a file to the markers of each person in it: metres, physical markers only,
right-handed axes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from habitus.errors import HabitusError
from habitus.io.captures.axes import Axes, find_axes
from habitus.io.captures.duplicate_points import find_copies, find_strangers
from habitus.io.captures.labels import computed_labels, is_unlabelled
from habitus.io.captures.points import RawPoints
from habitus.io.captures.subjects import Owner, split_subjects
from habitus.io.captures.trajectories import (
    Tracks,
    hide_far,
    hide_placeholders,
    hide_stuck,
    join_fragments,
)
from habitus.io.names import plain_name
from habitus.io.units import METRES, find_unit, restlessness
from habitus.parallel.blocks import drop_pages, mapped

_MOST_MARKERS = 500
_NOISE = 0.27


@dataclass(frozen=True)
class Person:
    """One subject's clean tracks, with the unit the file was in and the signed axis that is up."""

    subject: str | None
    tracks: Tracks
    unit: str
    up_axis: str


def find_people(raw: RawPoints, name: str) -> tuple[Person, ...]:
    """Every person in a file's points, the one with most markers first; ``name`` is what errors
    call the file.

    Unit and axes are the file's, so they are found once, from that person. Raises HabitusError
    where no marker is left.
    """
    raw = _named(replace(raw, points=hide_placeholders(raw.points)))
    declared = {
        bare: group
        for label, group in raw.groups.items()
        for bare in (label, label.rpartition(":")[2])
    }
    found = [
        (owner, _physical(owner, raw.points, declared))
        for owner in split_subjects(raw.labels, raw.subjects)
    ]
    found = [(owner, tracks) for owner, tracks in found if tracks.labels]
    if not found:
        raise HabitusError(_nothing_left(raw, declared, name))
    _refuse_noise(found[0][1].points, name)
    unit, warning = find_unit(found[0][1].labels, found[0][1].points, raw.unit)
    found = [
        (owner, cleaned)
        for owner, tracks in found
        if (cleaned := _clean(tracks, METRES[unit])).labels
    ]
    if not found:
        raise HabitusError(
            f"{name}: its points are kilometres apart, none near another; it is damaged, export "
            "it again"
        )
    axes = find_axes(found[0][1].labels, found[0][1].points, raw.up_claim, raw.up_usual)
    drop_pages(*(tracks.points for _, tracks in found))
    told = (*raw.warnings, *([warning] if warning else []), *_axis_warnings(raw, axes))
    return tuple(
        Person(
            owner.name,
            _righted(replace(tracks, warnings=(*told, *tracks.warnings)), axes),
            unit,
            axes.up,
        )
        for owner, tracks in found
    )


def _named(raw: RawPoints) -> RawPoints:
    """The same with labels and subjects in a safe spelling."""
    labels = tuple(map(plain_name, raw.labels))
    groups = {plain_name(label): plain_name(group) for label, group in raw.groups.items()}
    return replace(raw, labels=labels, groups=groups, subjects=tuple(map(plain_name, raw.subjects)))


def _refuse_noise(points: np.ndarray, name: str) -> None:
    """Damaged files, and files whose header tells the wrong layout, give numbers that are no
    trajectories.
    """
    share = restlessness(points)
    if share > _NOISE:
        raise HabitusError(
            f"{name}: its points jump about from frame to frame, by {share:.0%} of the body's "
            "size at the median; "
            "the file is damaged, export it again"
        )


def _physical(owner: Owner, points: np.ndarray, declared: Mapping[str, str]) -> Tracks:
    """Without computed, unlabelled and never visible points; fillers stay where there is nothing
    else.
    """
    whole = len(owner.columns) == points.shape[1]
    columns = list(owner.columns)
    tracks = Tracks(
        owner.labels, points if whole else mapped(lambda part: part[:, columns], points)
    )
    reasons = computed_labels(owner.labels, declared)
    fillers = [label for label in owner.labels if is_unlabelled(label) and label not in reasons]
    seen = {label for label, visible in zip(owner.labels, tracks.visible, strict=True) if visible}
    if seen - set(fillers) - set(reasons):
        reasons |= dict.fromkeys(fillers, "unlabelled")
    elif fillers:
        tracks = replace(tracks, warnings=("no point has a name: the markers are anonymous",))
    return _visible(tracks.without(reasons), "never visible")


def _visible(tracks: Tracks, reason: str) -> Tracks:
    hidden = tuple(
        (label, reason)
        for label, seen in zip(tracks.labels, tracks.visible, strict=True)
        if not seen
    )
    kept = tracks.keep(tracks.visible)
    return replace(kept, dropped=(*kept.dropped, *hidden))


def _clean(tracks: Tracks, metres: float) -> Tracks:
    """In metres, pieces joined; points betrayed by their values go, unless there are more than any
    body wears.
    """
    tracks = replace(tracks, points=mapped(lambda part: part * metres, tracks.points))
    tracks = _visible(hide_far(tracks), "never near the others")
    if len(tracks.labels) > _MOST_MARKERS:
        return join_fragments(tracks)
    tracks = hide_stuck(tracks)
    tracks = join_fragments(_visible(tracks, "never moves while the others do"))
    tracks = tracks.without(find_copies(tracks.labels, tracks.points))
    return tracks.without(find_strangers(tracks.labels, tracks.points))


def _axis_warnings(raw: RawPoints, axes: Axes) -> list[str]:
    warnings = []
    if axes.sure and raw.up_claim and raw.up_claim != axes.up:
        warnings.append(
            f"the file says {raw.up_claim} is up ({raw.up_source}), its data say {axes.up}, which "
            "is used"
        )
    if not axes.sure:
        source = (
            f"the file's word ({raw.up_source})"
            if raw.up_claim
            else f"usual for {raw.format} files"
        )
        warnings.append(f"the data do not tell which way is up: {axes.up} is taken, {source}")
    if axes.mirrored:
        axis = "xyz"[_flipped(axes.up)]
        warnings.append(
            "the capture is mirrored (left-handed axes, or left and right labels swapped): "
            f"{axis} is negated"
        )
    return warnings


def _flipped(up: str) -> int:
    """The axis a mirrored capture is negated along: the last that is not up."""
    return max(i for i in range(3) if "xyz"[i] != up[1])


def _righted(tracks: Tracks, axes: Axes) -> Tracks:
    if not axes.mirrored:
        return tracks
    signs = np.ones(3)
    signs[_flipped(axes.up)] = -1.0
    return replace(tracks, points=mapped(lambda part: part * signs, tracks.points))


def _nothing_left(raw: RawPoints, declared: Mapping[str, str], name: str) -> str:
    frames, count = raw.points.shape[:2]
    computed = len(computed_labels(raw.labels, declared))
    if computed == count:
        return (
            f"{name}: all of its {count} points are computed (joint centres, angles); give a "
            "capture with markers"
        )
    others = f" (its {computed} other points are computed)" if computed else ""
    return (
        f"{name}: all {count - computed} markers are missing in all {frames} frames{others}; "
        "export visible markers"
    )
