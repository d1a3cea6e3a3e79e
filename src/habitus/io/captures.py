"""Reading motion captures: one call for every format, the file's claims checked against its data.

capture = read_capture("walk.c3d")
capture.markers            # (T, M, 3) metres, the capture's own axes (right-handed), NaN where missing
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.axes import find_axes
from habitus.io.c3d import parse_c3d
from habitus.io.labels import computed_labels, is_unlabelled
from habitus.io.points import RawPoints
from habitus.io.subjects import Owner, split_subjects
from habitus.io.trajectories import find_copies, hide_placeholders, join_fragments
from habitus.io.units import METRES, find_unit

_PARSERS: Mapping[str, Callable[[bytes, str], RawPoints]] = {".c3d": parse_c3d}


@dataclass(frozen=True)
class Capture:
    """The markers of one person in one capture: T frames, M physical markers.

    ``markers`` are metres in the capture's own right-handed world frame, NaN where missing; ``up_axis`` is a signed axis such
    as "+z"; ``labels`` are free of subject prefixes; ``dropped`` names each point left out, with the reason; ``recorded``
    holds what the file says of the person (height_m, mass_kg, marker_diameter_m, sex); ``unit`` is the file's unit of length.
    """

    name: str
    labels: tuple[str, ...]
    markers: Float[np.ndarray, "T M 3"]
    rate_hz: float
    up_axis: str
    subject: str | None = None
    warnings: tuple[str, ...] = ()
    recorded: Mapping[str, float | str] = field(default_factory=dict)
    dropped: tuple[tuple[str, str], ...] = ()
    format: str = ""
    unit: str = "m"

    def __post_init__(self) -> None:
        self.markers.setflags(write=False)


def read_capture(path: str | os.PathLike[str], subject: str | None = None, rate_hz: float | None = None) -> Capture:
    """The capture in a file; of several people the one named ``subject``, else the one with most markers (with a warning).

    ``rate_hz`` overrides the file's frame rate. Raises HabitusError where the file holds no usable markers, names no rate,
    or holds nobody called ``subject``.
    """
    captures = read_captures(path, rate_hz)
    names = [capture.subject or "" for capture in captures]
    if subject is not None:
        for capture, name in zip(captures, names, strict=True):
            if name.lower() == subject.lower():
                return capture
        raise HabitusError(
            f"{Path(path).name}: holds no subject {subject!r}; it holds {', '.join(names) or 'one without a name'}"
        )
    if len(captures) > 1:
        warning = f"the file holds {len(captures)} subjects ({', '.join(names)}): {names[0]} is read; name another with subject"
        return replace(captures[0], warnings=(*captures[0].warnings, warning))
    return captures[0]


def read_captures(path: str | os.PathLike[str], rate_hz: float | None = None) -> tuple[Capture, ...]:
    """Every person in a capture file, the one with most markers first. Errors as for read_capture."""
    path = Path(path)
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise HabitusError(f"{path.name}: unknown kind of capture; expected one of {', '.join(_PARSERS)}")
    raw = parse(_content(path), path.name)
    rate = rate_hz if rate_hz is not None else raw.rate_hz
    if rate is None or not 0 < rate < 1e6:
        raise HabitusError(f"{path.name}: names no frame rate; give it as rate_hz (frames a second)")
    raw = replace(raw, points=hide_placeholders(raw.points), rate_hz=rate)
    captures = [_person(raw, owner, path) for owner in split_subjects(raw.labels, raw.subjects)]
    found = tuple(capture for capture in captures if capture.labels)
    if not found:
        raise HabitusError(_nothing_left(path.name, raw))
    return found


def _content(path: Path) -> bytes:
    if path.is_dir():
        raise HabitusError(f"{path}: is a folder; give a capture file")
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise HabitusError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise HabitusError(f"{path}: cannot be read ({error.strerror or error})") from None


def _nothing_left(name: str, raw: RawPoints) -> str:
    if not np.isfinite(raw.points).any():
        return f"{name}: all {len(raw.labels)} points are missing in all {len(raw.points)} frames; give a capture with visible markers"
    return f"{name}: none of its {len(raw.labels)} points is a physical marker; give a capture with markers"


def _person(raw: RawPoints, owner: Owner, path: Path) -> Capture:
    declared = {label: group for label, group in raw.groups.items()}
    declared |= {label.rpartition(":")[2]: group for label, group in raw.groups.items()}
    points = raw.points[:, list(owner.columns)]
    labels, points, dropped, warnings = _physical(owner.labels, points, declared)
    unit, unit_warning = find_unit(labels, points, raw.unit)
    points = points * METRES[unit]
    labels, points, joined, join_warnings = join_fragments(labels, points)
    copies = find_copies(labels, points)
    keep = [i for i, label in enumerate(labels) if label not in copies]
    labels, points = tuple(labels[i] for i in keep), np.ascontiguousarray(points[:, keep])
    axes = find_axes(labels, points, raw.up_claim)
    axis_warnings = []
    if axes.sure and raw.up_claim and raw.up_claim != axes.up:
        axis_warnings.append(
            f"the file says {raw.up_claim} is up ({raw.up_source}), the body says {axes.up}, which is used"
        )
    if axes.mirrored:
        flip = max(i for i in range(3) if "xyz"[i] != axes.up[1])
        points[..., flip] *= -1
        axis_warnings.append(
            f"the capture is mirrored (left-handed axes, or left and right labels swapped): {'xyz'[flip]} is negated"
        )
    every = (*raw.warnings, *warnings, *([unit_warning] if unit_warning else []), *join_warnings, *axis_warnings)
    recorded = raw.recorded.get(owner.name or "") or raw.recorded.get("", {})
    assert raw.rate_hz is not None
    return Capture(
        path.stem,
        labels,
        points,
        raw.rate_hz,
        axes.up,
        owner.name,
        every,
        dict(recorded),
        (*dropped, *joined, *copies.items()),
        raw.format,
        unit,
    )


def _physical(
    labels: tuple[str, ...], points: np.ndarray, declared: Mapping[str, str]
) -> tuple[tuple[str, ...], np.ndarray, tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Without computed, unlabelled and never visible points."""
    warnings = []
    reasons = computed_labels(labels, declared)
    unlabelled = {label for label in labels if is_unlabelled(label)}
    if len(unlabelled | set(reasons)) < len(set(labels)):
        reasons |= {label: "unlabelled" for label in unlabelled if label not in reasons}
    elif unlabelled:
        warnings.append("no point has a name: the markers are anonymous")
    visible = np.isfinite(points[..., 0]).any(axis=0)
    dropped = [
        (label, reasons.get(label, "never visible"))
        for label, seen in zip(labels, visible, strict=True)
        if label in reasons or not seen
    ]
    keep = [i for i, label in enumerate(labels) if visible[i] and label not in reasons]
    return tuple(labels[i] for i in keep), points[:, keep], tuple(dropped), tuple(warnings)
