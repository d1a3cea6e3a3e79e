"""TRC files (Motion Analysis, OpenSim): a text table of points with their names and units in a
header of five lines.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from habitus.errors import HabitusError
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
from habitus.io.captures.trc_columns import Columns, find_columns


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
    for key, found, what in (("nummarkers", markers, "markers"), ("numframes", frames, "frames")):
        claimed = number_of(header.get(key))
        if claimed is not None and claimed != found:
            warnings.append(f"the header counts {claimed:g} {what}, the file holds {found}")
    return warnings
