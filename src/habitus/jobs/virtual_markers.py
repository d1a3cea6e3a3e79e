"""Virtual markers of a body in motion, and captures whose gaps are filled from their fits. Files
in, files out.
"""

import csv
import io
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.errors import HabitusError, shown
from habitus.export.trc import write_trc
from habitus.files import atomic_write, write_text
from habitus.fit.markers.gaps import Filling, fill_gaps
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.c3d import parse_c3d
from habitus.io.captures.c3d_fill import filled_c3d
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture, read_captures
from habitus.io.layouts.files import load_layout
from habitus.io.people import read_fit, read_motion
from habitus.io.units import METRES
from habitus.observe.simulated_markers import (
    CLEAN,
    Faults,
    carried_markers,
    layout_attachment,
    recorded,
)
from habitus.types import PathLike

ENDINGS = (".c3d", ".trc")
_SEVERAL = (
    "no single column of the file holds this marker (exchanged labels, or a trajectory in pieces)"
)


def virtual_markers(
    source: Moving | PathLike,
    layout: PathLike | None = None,
    *,
    faults: Faults = CLEAN,
    seed: int = 0,
    body: BodyModel | PathLike | None = None,
    out: PathLike | None = None,
) -> Capture:
    """What a marker system would record of a body in motion: M markers in every frame, metres, the
    motion's own world.

    source: a fit, a motion, or the npz of one (`habitus.io.people.read_motion`). layout: a shipped
    one by name, or a file, without its optional markers; by itself a fit's own markers at the
    places that were found for them. faults: placement and noise (m, sd) and missing samples;
    `CLEAN` has none. out: a .c3d or .trc file that receives them. Raises HabitusError for a motion
    without markers where no layout is given, a layout that does not fit the body, and other
    endings.
    """
    target = None if out is None else _writable(out)
    moving = source if isinstance(source, Moving) else _loaded(source, layout, body)
    rng = np.random.default_rng(seed)
    if layout is None:
        if not isinstance(moving, MarkerFit):
            raise HabitusError(
                f"{moving.capture_name}: a motion has no markers of its own; name a layout, "
                "cmu-41 say"
            )
        name = "its own layout"
        labels = moving.labels
        attachment = moving.attachment
    else:
        marker_layout = load_layout(layout)
        marker_layout = marker_layout.restricted_to(
            tuple(marker.label for marker in marker_layout.markers if not marker.optional)
        )
        places = marker_layout.vertices(moving.body), marker_layout.distances()
        attachment = layout_attachment(moving, *places, faults.placement, rng)
        name = f"layout {marker_layout.name}"
        labels = marker_layout.labels
    markers = recorded(carried_markers(moving, attachment), faults, rng)
    note = (
        f"virtual marker ({name}) of the body {moving.body_name or moving.body.name} in the "
        f"motion {moving.capture_name}"
    )
    capture = Capture(
        moving.capture_name,
        labels,
        markers,
        moving.rate_hz,
        moving.up_axis,
        warnings=(note,),
        format="virtual",
    )
    if target is not None:
        _write(capture, target, note)
    return capture


@dataclass(frozen=True, eq=False)
class FilledCapture:
    """A capture whose gaps were filled from its fit: the markers of the person, and what was done
    (`Filling`).
    """

    capture: Capture
    filling: Filling

    @property
    def table(self) -> str:
        """Every gap, a line each (CSV): label, first and last frame (the file's first is 1), what
        was done, why not.
        """
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(
            ("label", "first_frame", "last_frame", "filled", "markers_seen_nearby", "why_not")
        )
        for gap in self.filling.gaps:
            rows.writerow(
                (
                    gap.label,
                    gap.first + 1,
                    gap.last + 1,
                    "no" if gap.why else "yes",
                    gap.nearby,
                    gap.why,
                )
            )
        return text.getvalue()


def fill_capture(
    fit: MarkerFit | PathLike,
    capture: PathLike,
    out: PathLike | None = None,
    *,
    body: BodyModel | PathLike | None = None,
) -> FilledCapture:
    """A capture with its gaps filled from the fit of it, and which samples those are.

    fit: a fit or its body.npz. capture: the file that was fitted. out: where it is written, with
    ``OUT.filled.csv`` beside it. A .c3d of a .c3d is the file itself, to the last bit, but for the
    filled samples, whose residual is 0, as the format says of what no camera measured; else the
    person's markers alone are written (.c3d, .trc). Raises HabitusError where this is not the
    capture that was fitted, and for other endings.
    """
    target = None if out is None else _writable(out)
    source = Path(capture)
    if (
        target is not None
        and target.exists()
        and os.path.realpath(target) == os.path.realpath(source)
    ):
        raise HabitusError(
            f"{target}: is the capture itself, which stays as it is; choose another name with --out"
        )
    marker_fit = fit if isinstance(fit, MarkerFit) else read_fit(fit, body)
    person, columns = _person(marker_fit, source)
    observed = np.full((len(person), len(marker_fit.labels), 3), np.nan)
    observed[:, columns >= 0] = person.markers[:, columns[columns >= 0]]
    left_out = {
        label: _SEVERAL
        for label, column in zip(marker_fit.labels, columns, strict=True)
        if column < 0
    }
    in_file = None
    if source.suffix.lower() == ".c3d":
        in_file = _file_columns(source, person, columns)
        left_out |= {
            label: _SEVERAL
            for label, (column, _) in zip(marker_fit.labels, in_file, strict=True)
            if column < 0
        }
    filling = fill_gaps(marker_fit, observed, left_out)
    markers = np.array(person.markers)
    for marker, column in enumerate(columns):
        if column >= 0:
            markers[filling.filled[:, marker], column] = filling.markers[
                filling.filled[:, marker], marker
            ]
    result = FilledCapture(replace(person, markers=markers), filling)
    if target is not None:
        if in_file is not None and target.suffix.lower() == ".c3d":
            _patch(source, target, in_file, filling)
        else:
            _write(result.capture, target, "")
        write_text(target.with_name(f"{target.name}.filled.csv"), result.table)
    return result


def _loaded(source: PathLike, layout: PathLike | None, body: BodyModel | PathLike | None) -> Moving:
    return read_motion(source, body) if layout is not None else read_fit(source, body)


def _writable(out: PathLike) -> Path:
    target = Path(out)
    if target.suffix.lower() not in ENDINGS:
        raise HabitusError(
            f"cannot write markers to {target.name}: expected a name in {', '.join(ENDINGS)}"
        )
    return target


def _write(capture: Capture, target: Path, note: str) -> None:
    writers: Mapping[str, Callable[[], None]] = {
        ".c3d": lambda: write_c3d(capture, target, note=note),
        ".trc": lambda: write_trc(capture, target),
    }
    writers[target.suffix.lower()]()


def _person(fit: MarkerFit, source: Path) -> tuple[Capture, np.ndarray]:
    """The person of the file who was fitted, and the column of each of the fit's markers, -1 where
    none is it.
    """
    people = [each for each in read_captures(source) if len(each) == fit.num_frames]
    matches = [(same_columns(fit.observed_markers, each.markers), each) for each in people]
    columns, person = max(
        matches, key=lambda pair: int((pair[0] >= 0).sum()), default=(np.zeros(0), None)
    )
    if person is None or 2 * (columns >= 0).sum() < len(fit.labels):
        held = (
            "frames of another number"
            if person is None
            else f"{int((columns >= 0).sum())} of its markers"
        )
        raise HabitusError(
            f"{source}: is not the capture that was fitted ({shown(fit.capture_name)}): it holds "
            f"{held}; give that one"
        )
    return person, columns


def _file_columns(
    source: Path, person: Capture, columns: np.ndarray
) -> list[tuple[int, np.ndarray]]:
    """For each of the fit's markers its point in a C3D file (-1: none), and what takes metres to
    the file's axes.
    """
    raw = parse_c3d(source.read_bytes(), source.name)
    unit = METRES[person.unit]
    known = columns >= 0
    best = np.full(len(columns), -1), np.ones(3)
    for signs in (np.ones(3), *(1.0 - 2.0 * np.eye(3))):  # a mirrored capture has one axis negated
        indices = np.full(len(columns), -1)
        indices[known] = same_columns(
            person.markers[:, columns[known]], raw.points * (unit * signs)
        )
        if (indices >= 0).sum() > (best[0] >= 0).sum():
            best = indices, signs
    return [(int(column), best[1] / unit) for column in best[0]]


def _patch(
    source: Path, target: Path, columns: list[tuple[int, np.ndarray]], filling: Filling
) -> None:
    known = [k for k, (column, _) in enumerate(columns) if column >= 0]
    points = np.stack([np.nan_to_num(filling.markers[:, k]) * columns[k][1] for k in known], axis=1)
    where = np.array([columns[k][0] for k in known])
    content = filled_c3d(source.read_bytes(), source.name, where, points, filling.filled[:, known])
    with atomic_write(os.fspath(target)) as temporary:
        temporary.write_bytes(content)


SAME = 1e-3
"""Metres within which two samples are one."""
_LOOKED_AT = 40


def same_columns(
    targets: Float[np.ndarray, "T M 3"], tracks: Float[np.ndarray, "T N 3"]
) -> Int[np.ndarray, " M"]:
    """For each marker ``targets`` the column of ``tracks`` that holds every sample of it, NaN where
    missing; else -1.

    ``tracks`` may hold more samples. Of several equal columns it is the first.
    """
    return np.array(
        [_column(targets[:, marker], tracks) for marker in range(targets.shape[1])], dtype=np.int64
    )


def _column(track: np.ndarray, tracks: np.ndarray) -> int:
    seen = np.flatnonzero(np.isfinite(track[:, 0]))
    if not len(seen):
        return -1
    some = seen[np.linspace(0, len(seen) - 1, min(_LOOKED_AT, len(seen))).astype(int)]
    near = _same(track[some, None], tracks[some]).all(axis=0)
    return next(
        (int(k) for k in np.flatnonzero(near) if _same(track[seen], tracks[seen, k]).all()), -1
    )


def _same(samples: np.ndarray, other: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.abs(samples - other).max(axis=-1) < SAME  # false for NaN
