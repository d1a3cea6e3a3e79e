"""Reads TRC files, whose headers and columns every tool writes its own way."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.io.captures.points import RawPoints
from habitus.io.captures.tables import (
    agreed_rate,
    fill_frames,
    is_count,
    mean_rate,
    number_of,
    number_table,
    read_text,
)
from habitus.io.limits import open_file

_AXIS = re.compile(r"([XYZ])[ _]?\d*", re.IGNORECASE)
_TIME = re.compile(r"(frame\W*)?(time|t\b|sec)", re.IGNORECASE)
_FIRST = 2  # after the frame's number and time
_ODD_ROWS = 0.02  # so many rows may be damaged

Place = tuple[int, int, int]


@dataclass(frozen=True)
class Columns:
    """The label and the columns of x, y, z of each marker, and what is to be said of them."""

    labels: tuple[str, ...]
    places: tuple[Place, ...]
    warnings: tuple[str, ...] = ()

    @property
    def first(self) -> int:
        """The first column that holds a coordinate."""
        return min(map(min, self.places))

    @property
    def end(self) -> int:
        """One past the last column that holds a coordinate."""
        return 1 + max(map(max, self.places))


def find_columns(
    names: Sequence[str],
    axes: Sequence[str],
    spans: Sequence[tuple[int, int]],
    spaced: bool,
    name: str,
) -> Columns:
    """The columns of a TRC file ``name``, from its row of names, the row below and the ``spans`` of
    its rows of data.

    A span is the first column with a coordinate and one past the last; ``spaced``: blanks part the
    cells, so that the names' columns mean nothing. Raises HabitusError where no reading of the
    header fits the data.
    """
    named = [
        (i, cell)
        for i, cell in enumerate(names)
        if cell and i and not (i == 1 and _TIME.match(cell))
    ]
    if not named:
        raise HabitusError(
            f"{name}: its 'Frame#' line names no markers; export it again with marker names"
        )
    triples = _triples(axes, name)
    readings = [reading for reading in _readings(named, triples, spaced) if reading is not None]
    first, end = _extent(spans)
    fitting = [
        one
        for one in readings
        if one.first <= first and end <= one.end and (one.end - end) % 3 == 0
    ]
    if not fitting:
        axes_told = f" and its X1 Y1 Z1 row {len(triples)}" if triples else ""
        raise HabitusError(
            f"{name}: its header names {len(named)} markers{axes_told}, its rows hold numbers in "
            f"columns {first + 1} "
            f"to {end}, which are not x, y and z of these; export it again"
        )
    return fitting[0]


def _readings(
    named: list[tuple[int, str]], triples: list[Place], spaced: bool
) -> Iterator[Columns | None]:
    """The ways to read the header, the likeliest first."""
    labels = tuple(cell for _, cell in named)
    in_order = Columns(labels, tuple(_triple(_FIRST + 3 * i) for i in range(len(named))))
    spread = (
        not spaced
        and len(named) > 1
        and all(later - earlier == 3 for (earlier, _), (later, _) in pairwise(named))
    )
    if triples:
        yield _named_triples(named, triples, spaced)
        note = (
            "the file's X1 Y1 Z1 row does not fit its numbers: the columns are those of the names"
        )
        in_order = replace(in_order, warnings=(note,))
    if spread:
        own = Columns(labels, tuple(_triple(i) for i, _ in named), in_order.warnings)
        yield own
        if own.places != in_order.places:
            in_order = replace(in_order, warnings=(_beside(named[0][0], _FIRST),))
    yield in_order


def _named_triples(
    named: list[tuple[int, str]], triples: list[Place], spaced: bool
) -> Columns | None:
    """The X1 Y1 Z1 row's columns with the names above them, or in order; None where that leaves a
    doubt.
    """
    starts = [min(triple) for triple in triples]
    columns = [i for i, _ in named]
    warnings = []
    if spaced or columns == [
        *range(columns[0], columns[0] + len(columns))
    ]:  # the names are not spread
        columns = starts[: len(columns)] if len(columns) == len(starts) else []
    elif len(columns) == len(starts) and columns != starts:
        warnings.append(_beside(columns[0], starts[0]))
        columns = starts
    elif not set(columns) & set(starts):
        warnings.append(_beside(columns[0], starts[0]))
        columns = [column - columns[0] + starts[0] for column in columns]
    at = {column: cell for column, (_, cell) in zip(columns, named, strict=False)}
    if not set(at) & set(starts):
        return None
    lost = [shown(cell) for column, cell in at.items() if column not in starts]
    nameless = sum(start not in at for start in starts)
    if lost:
        warnings.append(
            f"{len(lost)} labels without x, y and z are left out: {', '.join(lost[:5])}"
        )
    if nameless:
        warnings.append(f"{nameless} of {len(starts)} points have no name")
    labels = tuple(at.get(start) or f"*{i}" for i, start in enumerate(starts))
    return Columns(labels, tuple(triples), tuple(warnings))


def _beside(names: int, numbers: int) -> str:
    return (
        f"the markers' names begin in column {names + 1}, their coordinates in column "
        f"{numbers + 1}, which is used"
    )


def _triple(start: int) -> Place:
    return start, start + 1, start + 2


def _triples(axes: Sequence[str], name: str) -> list[Place]:
    """The columns of x, y, z under each marker, as the X1 Y1 Z1 row has them; none where it is no
    such row.
    """
    places = [
        (i, match[1].upper()) for i, cell in enumerate(axes) if (match := _AXIS.fullmatch(cell))
    ]
    if not places or len(places) < sum(map(bool, axes)):
        return []
    shift = max(0, _FIRST - places[0][0])  # a row that leaves out the blanks under frame and time
    triples = []
    for k in range(0, len(places), 3):
        place = {letter: i + shift for i, letter in places[k : k + 3]}
        if len(place) < 3 or max(place.values()) - min(place.values()) != 2:
            raise HabitusError(
                f"{name}: the coordinates of its point {k // 3 + 1} are "
                f"{' '.join(c for _, c in places[k : k + 3])}; "
                "expected X, Y and Z of each; export it again"
            )
        triples.append((place["X"], place["Y"], place["Z"]))
    return triples


def _extent(spans: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The columns that hold coordinates, but for a few damaged rows; (2, 2) where there are
    none.
    """
    filled = np.array([span for span in spans if span[1] > span[0]]).reshape(-1, 2)
    if not len(filled):
        return _FIRST, _FIRST
    first = np.percentile(filled[:, 0], 100 * _ODD_ROWS, method="higher")
    return int(first), int(np.percentile(filled[:, 1], 100 * (1 - _ODD_ROWS), method="lower"))


FIT_EXPORT = "joints and markers of a fit by habitus"
"""In the first line of files that `habitus export` wrote: points of a body, and no capture."""

MAX_FIRST_LINE = 4096
"""Bytes of a TRC file that are searched for the mark."""


def is_fit_export(path: Path) -> bool:
    """Whether a file is a TRC that `habitus export` wrote; False where it cannot be read."""
    if path.suffix.lower() != ".trc":
        return False
    try:
        with open_file(path) as file:
            return FIT_EXPORT.encode() in file.readline(MAX_FIRST_LINE)
    except OSError:
        return False


def parse_trc(content: bytes, name: str) -> RawPoints:
    """The points of a TRC file's bytes; blank cells and zeros are missing, y is up unless the data
    say otherwise.

    Raises HabitusError where the text is no TRC file or holds no points or frames.
    """
    lines = read_text(content, name).splitlines()
    separator = "\t" if any("\t" in line for line in lines[:5]) else None
    rows = [_cells(line, separator) for line in lines]
    top = next(
        (
            i
            for i, row in enumerate(rows[:12])
            if row and row[0].strip().lower().startswith("frame")
        ),
        None,
    )
    if top is None:
        raise HabitusError(
            f"{name}: not a TRC file (no line begins with 'Frame#'); export it again as TRC"
        )
    header = _header(rows[:top])
    data = [row for row in rows[top + 1 :] if row and is_count(row[0])]
    if not data:
        raise HabitusError(f"{name}: holds no frames below its 'Frame#' line; export it again")
    spans = [_span(row) for row in data]
    columns = find_columns(
        rows[top], rows[top + 1] if top + 1 < len(rows) else [], spans, separator is None, name
    )
    points, time, warnings = _points(data, spans, columns, separator is None, name)
    rate, rate_warnings = agreed_rate(
        number_of(header.get("datarate")), mean_rate(time, len(points))
    )
    return RawPoints(
        format="trc",
        labels=columns.labels,
        points=points,
        rate_hz=rate,
        unit=header.get("units"),
        up_usual="+y",
        warnings=(
            *columns.warnings,
            *rate_warnings,
            *warnings,
            *_count_warnings(header, len(columns.labels), len(data)),
        ),
    )


def _points(
    data: Sequence[Sequence[str]],
    spans: Sequence[tuple[int, int]],
    columns: Columns,
    spaced: bool,
    name: str,
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """The points (T, N, 3), the times of the rows, and warnings; rows whose numbers stand elsewhere
    are missing.
    """
    table = number_table(data, columns.end, name)
    points = table[:, [column for place in columns.places for column in place]].reshape(
        len(data), -1, 3
    )
    odd = np.array(
        [begin < end and (begin < columns.first or end > columns.end) for begin, end in spans]
    )
    if spaced:  # a blank cell leaves no trace: the numbers after it would be another marker's
        odd |= np.array([end < columns.end for _, end in spans])
    warnings: tuple[str, ...] = ()
    if odd.any():
        points[odd] = np.nan
        warnings = (
            f"{odd.sum()} rows hold more or fewer numbers than the markers have: they are missing",
        )
    points, gap_warnings = fill_frames(table[:, 0], points)
    return points, table[:, 1], (*warnings, *gap_warnings)


def _span(row: Sequence[str]) -> tuple[int, int]:
    """The first column after frame and time that is filled, and one past the last."""
    end = len(row)
    while end > 2 and not row[end - 1]:
        end -= 1
    begin = 2
    while begin < end and not row[begin]:
        begin += 1
    return begin, max(end, 2)


def _cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(separator)]


def _header(rows: Sequence[Sequence[str]]) -> dict[str, str]:
    """The names of the line that has DataRate against the values of the line below it."""
    for names, values in pairwise(rows):
        if any(cell.lower() == "datarate" for cell in names):
            return {key.lower(): value for key, value in zip(names, values, strict=False)}
    return {}


def _count_warnings(header: dict[str, str], markers: int, frames: int) -> list[str]:
    warnings = []
    for key, actual, what in (("nummarkers", markers, "markers"), ("numframes", frames, "frames")):
        claimed = number_of(header.get(key))
        if claimed is not None and claimed != actual:
            warnings.append(f"the header counts {claimed:g} {what}, the file holds {actual}")
    return warnings
