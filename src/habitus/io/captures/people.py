"""From the points of a file to the markers of each subject in it: metres, physical markers only,
right-handed axes.

Which labels are not physical markers (computed points, unlabelled ones) is judged by name alone,
from the surest test to the least: what the file itself declares, names that can mean nothing else,
names that are computed only in the company of others (a Plug-in Gait bone LFEO comes with LFEA,
LFEL, LFEP).
"""

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from habitus.errors import HabitusError
from habitus.io.captures.points import RawPoints
from habitus.io.captures.trajectories import (
    Tracks,
    duplicate_points,
    hide_far,
    hide_placeholders,
    hide_stuck,
    join_fragments,
    off_body_points,
)
from habitus.io.names import plain_name
from habitus.io.units import METRES, Axes, find_axes, find_unit, restlessness
from habitus.parallel.blocks import drop_pages, mapped

_SIDE = re.compile(r"(q_)?(l|r|left|right|lt|rt)", re.IGNORECASE)
_NO_NAME = {"", "Q", "unlabeled", "unlabelled"}
_MIN_MARKERS = 8
_SAMPLE = 500


@dataclass(frozen=True)
class Owner:
    """A subject's name (None where the file names nobody) and the columns and bare labels that are
    theirs.
    """

    name: str | None
    columns: tuple[int, ...]
    labels: tuple[str, ...]


def split_subjects(labels: Sequence[str], named: Sequence[str] = ()) -> tuple[Owner, ...]:
    """One owner per subject prefix, the one with most labels first; ``named`` are the subjects the
    file itself names.

    Labels without a prefix go to the only subject; where there are several they are nobody's and
    are left out.
    """
    prefixes = [_prefix(label, named) for label in labels]
    people = _people(Counter(prefix for prefix in prefixes if prefix))
    if not people:
        prefixes, people = _underscored(labels)
    if not people:
        return (_single(labels, named),)
    if len(people) == 1:
        bare = tuple(_bare(label, people[0]) for label in labels)
        return (Owner(_name(people[0]), tuple(range(len(labels))), bare),)
    return tuple(_owner(person, labels, prefixes) for person in people)


def _owner(person: str, labels: Sequence[str], prefixes: Sequence[str]) -> Owner:
    columns = tuple(i for i, prefix in enumerate(prefixes) if prefix == person)
    return Owner(_name(person), columns, tuple(_bare(labels[i], person) for i in columns))


def _name(prefix: str) -> str | None:
    name = prefix.strip(" _:.")
    return None if name in _NO_NAME else name


def _bare(label: str, prefix: str) -> str:
    return label.removeprefix(prefix).strip() or label.strip()


def _people(counts: Counter[str]) -> list[str]:
    """The prefixes that are people rather than props: those with a good share of the markers of the
    largest.
    """
    most = max(counts.values(), default=0)
    least = max(_MIN_MARKERS, most // 4)
    return [prefix for prefix, count in counts.most_common() if count == most or count >= least]


def _prefix(label: str, named: Sequence[str]) -> str:
    """The part of a label that names a subject, with its separator; "" where there is none."""
    head, colon, rest = label.rpartition(":")
    if colon and rest.strip() and head.strip().lower() not in _NO_NAME:
        return head + colon
    for name in named:
        for separator in "_ .":
            if name and label.startswith(name + separator) and len(label) > len(name) + 1:
                return name + separator
    return ""


def _underscored(labels: Sequence[str]) -> tuple[list[str], list[str]]:
    """People told apart by ``Name_LABEL``: nearly all labels have such a head, and the heads share
    their labels.
    """
    heads = [label.split("_", 1)[0] + "_" if "_" in label.strip("_") else "" for label in labels]
    counts = Counter(heads)
    people = [
        head
        for head, count in counts.items()
        if head and count >= _MIN_MARKERS and not _SIDE.fullmatch(head[:-1])
    ]
    if len(people) < 2 or sum(counts[head] for head in people) < 0.9 * len(labels):
        return heads, []
    sets = [
        {label.removeprefix(head) for label, own in zip(labels, heads, strict=True) if own == head}
        for head in people
    ]
    shared = set.intersection(*sets)
    alike = len(shared) >= 0.6 * max(map(len, sets)) and not all(
        is_unlabelled(label) for label in shared
    )
    return heads, sorted(people, key=lambda head: -counts[head]) if alike else []


def _single(labels: Sequence[str], named: Sequence[str]) -> Owner:
    """Everything is one person's; a prefix such as ``Karlie_`` that nearly all labels share is
    taken off.
    """
    prefix = _common_prefix(labels)
    name = _name(prefix) or (named[0] if len(named) == 1 else None)
    return Owner(name, tuple(range(len(labels))), tuple(_bare(label, prefix) for label in labels))


def _common_prefix(labels: Sequence[str]) -> str:
    """The longest ``Name_`` that nine in ten labels share, that is no side and leaves names, not
    numbers.
    """
    candidates: Counter[str] = Counter()
    labels = labels[:: 1 + len(labels) // _SAMPLE]
    for label in labels:
        ends = [match.end() for match in re.finditer(r"(?<!_)[_ ](?!_)", label)]
        candidates.update(label[:end] for end in ends if not is_unlabelled(label[end:]))
    least = max(_MIN_MARKERS, 0.9 * len(labels))
    good = [
        prefix
        for prefix, count in candidates.items()
        if count >= least and not _SIDE.fullmatch(prefix[:-1])
    ]
    return max(good, key=len, default="")


_MAX_MARKERS = 500
_NOISE = 0.27


@dataclass(frozen=True)
class SubjectTracks:
    """One subject's clean tracks, with the unit the file was in, the signed axis that is up, and
    what was not decided of the axes.
    """

    subject: str | None
    tracks: Tracks
    unit: str
    up_axis: str
    doubts: tuple[str, ...] = ()


def find_people(raw: RawPoints, name: str) -> tuple[SubjectTracks, ...]:
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
    people = [
        (owner, _physical(owner, raw.points, declared))
        for owner in split_subjects(raw.labels, raw.subjects)
    ]
    people = [(owner, tracks) for owner, tracks in people if tracks.labels]
    if not people:
        raise HabitusError(_nothing_left(raw, declared, name))
    _refuse_noise(people[0][1].points, name)
    unit, warning = find_unit(people[0][1].labels, people[0][1].points, raw.unit)
    people = [
        (owner, cleaned)
        for owner, tracks in people
        if (cleaned := _clean(tracks, METRES[unit])).labels
    ]
    if not people:
        raise HabitusError(
            f"{name}: its points are kilometres from each other; it is damaged, export it again"
        )
    axes = find_axes(people[0][1].labels, people[0][1].points, raw.up_claim, raw.up_usual)
    drop_pages(*(tracks.points for _, tracks in people))
    warnings = (*raw.warnings, *([warning] if warning else []), *_axis_warnings(raw, axes))
    return tuple(
        SubjectTracks(
            owner.name,
            _righted(replace(tracks, warnings=(*warnings, *tracks.warnings)), axes),
            unit,
            axes.up,
            _axis_doubts(axes),
        )
        for owner, tracks in people
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
    if len(tracks.labels) > _MAX_MARKERS:
        return join_fragments(tracks)
    tracks = hide_stuck(tracks)
    tracks = join_fragments(_visible(tracks, "never moves while the others do"))
    tracks = tracks.without(duplicate_points(tracks.labels, tracks.points))
    return tracks.without(off_body_points(tracks.labels, tracks.points))


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
        warnings.append(f"the data do not determine the up axis: {axes.up} is assumed, {source}")
    return [*warnings, *_axis_doubts(axes)]


def _axis_doubts(axes: Axes) -> tuple[str, ...]:
    """That a capture is mirrored, and how it was read."""
    if not axes.mirrored:
        return ()
    axis = "xyz"[_flipped(axes.up)]
    return (
        "Either the capture's axes are left-handed, or left and right labels are exchanged "
        f"throughout: it was read as left-handed and {axis} negated; if labels are exchanged, the "
        "person and the motion come out mirrored.",
    )


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


_UNLABELLED = re.compile(
    r"(\*\d*|uname\*?\d*|u_?\d+|unlabell?ed[ _:-]?\d*|unidentified[ _-]?\d*|unknown[ _-]?\d*|new[ "
    r"_-]?\d+|ghost\d*"
    r"|nan|m?\d+|c_?\d{2,}|h\d+b\d+m\d+|(marker|point|channel)[ _-]*\d+|traj\w*[ _-]?\d+|)",
    re.IGNORECASE,
)
_MODEL_OUTPUT = re.compile(r".*(Angles?|Ang|Force|Moment|Power|GRF)")
_MASS_CENTRE = re.compile(r"(CentreOfMass|CenterOfMass|CoM|COM)(Floor)?")
_BONE = re.compile(r"(HED|TRX|PEL|CSP|SAC|[LR](?:CL|FE|FO|HN|HU|RA|TI|TO))([OALP])")
_JOINT_CENTRE = re.compile(
    r"([LR]?[_.]?(HJC|KJC|AJC|SJC|EJC|WJC|FJC|GHJC)([_.]?\w*)?"
    r"|.*_CGM_?\d.*|.*_projection|mid_.*|proj[A-Z].*|[LR][._]?\w*(Joint|Ground))"
)
_OXFORD = re.compile(
    r"[LR](ANK1|D1M0|FOF[0-3]|HDF[0-3]|HLX[0-3]|HE1|TIB[123]|PROXFF|HFplantar|ArchHeight(Index)?|ViconLegLength)"
)
_OXFORD_ANGLE = re.compile(
    r"[LR](FETBA|TIBA|HFTFL|HFTBA|FFTBA|FFHFA|HXFFA|HPA|KNA|ANA|FTA)|TrunkOffsetA|Belfast.*Angles|OxfordTrunk.*Angles"
)
_SOLVER = re.compile(r"SolvingHips|LabelingHips|[OXYZ]global")
_SKELETON = frozenset(
    [
        "Hips",
        "Spine",
        "Spine1",
        "Spine2",
        "Spine3",
        "Neck",
        "Head",
        "LeftShoulder",
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
        "LeftUpLeg",
        "LeftLeg",
        "LeftFoot",
        "LeftToeBase",
        "RightShoulder",
        "RightArm",
        "RightForeArm",
        "RightHand",
        "RightUpLeg",
        "RightLeg",
        "RightFoot",
        "RightToeBase",
    ]
)
_KEYPOINT = re.compile(
    r"Neck|Nose|[mM]idHip|[LR](Shoulder|Elbow|Wrist|Hip|Knee|Ankle|Eye|Ear|BigToe|SmallToe|Heel)",
    re.IGNORECASE,
)


def is_unlabelled(label: str) -> bool:
    """Whether a label is a system's filler for a trajectory that nobody named."""
    return _UNLABELLED.fullmatch(label.strip()) is not None


def computed_labels(labels: Collection[str], declared: Mapping[str, str]) -> dict[str, str]:
    """The labels that name computed points, each with the reason.

    ``declared`` is what the file says of its labels (label -> group such as "ANGLES").
    """
    names = frozenset(labels)
    video = sum(label.endswith("_study") for label in labels) >= 5
    tests: tuple[tuple[Callable[[str], object], str], ...] = (
        (_MODEL_OUTPUT.fullmatch, "its name is that of an angle, force, moment or power"),
        (_MASS_CENTRE.fullmatch, "a centre of mass is computed"),
        (lambda label: _is_bone(label, names), "a Plug-in Gait bone axis is computed"),
        (lambda label: _is_joint_centre(label), "a joint centre or projection is computed"),
        (lambda label: _is_oxford(label, names), "an Oxford Foot Model point is computed"),
        (lambda label: _is_oxford_angle(label, names), "an Oxford Foot Model angle is no place"),
        (
            lambda label: _is_copy_by_name(label, names),
            "a copy or mean of other markers, by its name",
        ),
        (
            lambda label: _KEYPOINT.fullmatch(label) and video,
            "a keypoint that a network saw in video, no marker",
        ),
        (_SOLVER.fullmatch, "a solver's helper point is computed"),
        (
            lambda label: label in _SKELETON and len(names & _SKELETON) >= 8,
            "a skeleton's bone is computed",
        ),
    )
    computed: dict[str, str] = {}
    for label in labels:
        if label in declared:
            computed[label] = f"the file lists it among its {declared[label]}"
            continue
        reason = next((reason for test, reason in tests if test(label)), None)
        if reason:
            computed[label] = reason
    return computed


def _is_bone(label: str, names: Collection[str]) -> bool:
    bone = _BONE.fullmatch(label)
    return bone is not None and sum(f"{bone[1]}{letter}" in names for letter in "OALP") >= 3


def _is_joint_centre(label: str) -> bool:
    return "__" not in label and _JOINT_CENTRE.fullmatch(label) is not None


def _is_oxford(label: str, names: Collection[str]) -> bool:
    """Oxford names mean real markers elsewhere (TIB1..3 of a cluster, HLX): only with the model's
    own origins.
    """
    return _OXFORD.fullmatch(label) is not None and any(
        f"{side}{name}" in names for side in "LR" for name in ("HDF0", "FOF0")
    )


def _is_oxford_angle(label: str, names: Collection[str]) -> bool:
    """RFTA is a foot marker where RFTB stands beside it (cluster sets)."""
    return _OXFORD_ANGLE.fullmatch(label) is not None and f"{label[:-1]}B" not in names


def _is_copy_by_name(label: str, names: Collection[str]) -> bool:
    if label in ("LKAX", "RKAX"):
        return f"{label[0]}KD1" not in names and f"{label[0]}KD2" not in names
    if label == "MIHD":
        return len({"LFHD", "RFHD", "LBHD", "RBHD"} & set(names)) >= 2
    if label == "JUG":
        return "CLAV" in names
    if label.endswith("_study"):
        return label.removesuffix("_study") in names
    return False
