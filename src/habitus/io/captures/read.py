"""Reading motion captures: one call for every format, the file's claims checked against its data.

``read_capture("walk.c3d").markers`` are (T, M, 3) in metres and in the capture's own right-handed
axes, NaN where missing.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from habitus.errors import LONGEST_MESSAGE, HabitusError, shown
from habitus.io.captures.c3d import parse_c3d
from habitus.io.captures.motive_csv import parse_motive_csv
from habitus.io.captures.npz import parse_npz
from habitus.io.captures.people import SubjectTracks, find_people
from habitus.io.captures.points import RawPoints
from habitus.io.captures.qtm_tsv import parse_qtm_tsv
from habitus.io.captures.trc import parse_trc
from habitus.io.limits import read_file
from habitus.io.names import shown_stem
from habitus.parallel.blocks import blocks

PARSERS: Mapping[str, Callable[[bytes, str], RawPoints]] = {
    ".c3d": parse_c3d,
    ".trc": parse_trc,
    ".csv": parse_motive_csv,
    ".tsv": parse_qtm_tsv,
    ".npz": parse_npz,
}

SLOWEST_HZ = 0.1
FASTEST_HZ = 20_000.0
USUAL_HZ = 5.0, 2_000.0


def _partly_missing(markers: Float[np.ndarray, "T M 3"]) -> Bool[np.ndarray, "T M"]:
    known = np.isfinite(markers)
    return known.any(axis=2) != known.all(axis=2)


@dataclass(frozen=True)
class Capture:
    """The markers of one person in one capture: T frames, M physical markers.

    ``markers`` are metres in the capture's own right-handed world frame, read-only, NaN where
    missing: a marker without one of its coordinates is missing; ``up_axis`` is a signed axis such
    as "+z"; ``labels`` are free of subject prefixes; ``dropped`` names each point left out, with
    the reason; ``recorded`` holds what the file says of the person (height_m, mass_kg,
    marker_diameter_m, age_years, sex); ``unit`` is the unit of length that the file's numbers are
    in; ``doubts`` say what the data did not decide, a sentence each.
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
    doubts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if any(_partly_missing(self.markers[part]).any() for part in blocks(len(self.markers))):
            whole = np.where(_partly_missing(self.markers)[..., None], np.nan, self.markers)
            object.__setattr__(self, "markers", whole)
        self.markers.setflags(write=False)

    def __repr__(self) -> str:
        """One line: what it is, not its numbers."""
        who = "" if self.subject is None else f" of {shown(self.subject)}"
        count = len(self.warnings)
        said = f", {count} warning{'s' * (count > 1)}" if count else ""
        return (
            f"<Capture {shown(self.name)}{who}: {len(self)} frames of {len(self.labels)} markers "
            f"at {self.rate_hz:g} Hz, {self.up_axis} up{said}>"
        )

    def __len__(self) -> int:
        """T."""
        return len(self.markers)

    def __getitem__(self, frames: slice) -> "Capture":
        """Some of its frames: ``capture[:200]``. Raises HabitusError for anything but a slice."""
        if not isinstance(frames, slice):
            raise HabitusError(
                f"a capture was asked for [{frames!r}]; expected a slice of frames, as "
                "capture[:200]"
            )
        rate = self.rate_hz / abs(frames.step or 1)
        return replace(self, markers=np.ascontiguousarray(self.markers[frames]), rate_hz=rate)


def read_capture(
    path: str | os.PathLike[str], subject: str | None = None, fps: float | None = None
) -> Capture:
    """The capture in a file: of several people the one named ``subject``, else the one with most
    markers and a warning.

    ``fps`` overrides the file's frame rate. Raises HabitusError where the file is of an unknown
    kind or damaged, holds no physical markers, names no rate, or has no person called ``subject``.
    """
    captures = read_captures(path, fps)
    names = [capture.subject or "one without a name" for capture in captures]
    if subject is not None:
        for capture in captures:
            if (capture.subject or "").lower() == subject.lower():
                return capture
        raise HabitusError(
            f"{Path(path).name}: holds no subject {subject!r}; it holds {', '.join(names)}"
        )
    if len(captures) == 1:
        return captures[0]
    warning = (
        f"the file holds {len(captures)} subjects ({', '.join(names)}): {names[0]} is read; "
        "name another with subject"
    )
    return replace(captures[0], warnings=(*captures[0].warnings, warning))


def read_captures(path: str | os.PathLike[str], fps: float | None = None) -> tuple[Capture, ...]:
    """Every person in a capture file, the one with most markers first. Errors as for
    read_capture.
    """
    path = Path(path)
    raw, rate = read_raw(path, fps)
    return captures_of(raw, rate, shown_stem(path), path.name)


def captures_of(raw: RawPoints, rate_hz: float, name: str, source: str) -> tuple[Capture, ...]:
    """Every person in some points, of a file or a stream; ``source`` is what errors call it. Raises
    HabitusError.
    """
    return tuple(_capture(person, raw, name, rate_hz) for person in find_people(raw, source))


def read_raw(path: Path, fps: float | None = None) -> tuple[RawPoints, float]:
    """What a file holds, and its frame rate; ``fps`` overrides it. Raises HabitusError."""
    content = _content(path)
    raw = PARSERS[path.suffix.lower()](content, path.name)
    rate = raw.rate_hz if fps is None else fps
    if rate is None or not SLOWEST_HZ <= rate <= FASTEST_HZ:
        named = "names no frame rate" if rate is None else f"its frame rate is {rate:g} Hz"
        raise HabitusError(
            f"{path.name}: {named}; expected {SLOWEST_HZ:g} to {FASTEST_HZ:g} frames a second, "
            "give them as fps"
        )
    return raw, float(rate)


def _content(path: Path) -> bytes:
    if path.is_dir():
        raise HabitusError(f"{path}: is a folder; give a capture file ({', '.join(PARSERS)})")
    if path.suffix.lower() not in PARSERS:
        raise HabitusError(
            f"{path.name}: unknown kind of capture; expected one of {', '.join(PARSERS)}"
        )
    try:
        return read_file(path)
    except FileNotFoundError:
        raise HabitusError(f"{path}: no such file; check the path") from None
    except (OSError, MemoryError, ValueError) as error:
        reason = (
            getattr(error, "strerror", None) or str(error) or "too large for this machine's memory"
        )
        raise HabitusError(f"{path}: cannot be read ({reason}); check its permissions") from None


def _capture(person: SubjectTracks, raw: RawPoints, name: str, rate_hz: float) -> Capture:
    unusual = (
        ()
        if USUAL_HZ[0] <= rate_hz <= USUAL_HZ[1]
        else (f"{rate_hz:g} Hz is an unusual frame rate: check it",)
    )
    return Capture(
        name=name,
        labels=person.tracks.labels,
        markers=np.ascontiguousarray(person.tracks.points),
        rate_hz=float(rate_hz),
        up_axis=person.up_axis,
        subject=person.subject,
        warnings=tuple(
            shown(text, LONGEST_MESSAGE) for text in (*unusual, *person.tracks.warnings)
        ),
        recorded=dict(raw.recorded),
        dropped=person.tracks.dropped,
        format=raw.format,
        unit=person.unit,
        doubts=person.doubts,
    )
