"""TRC files (Motion Analysis, OpenSim): a text table of points with their names and units in a header of five lines."""

from collections.abc import Sequence
from itertools import pairwise

from habitus.errors import HabitusError
from habitus.io.captures.points import RawPoints
from habitus.io.captures.tables import agreed_rate, fill_frames, is_count, mean_rate, number_of, number_table, read_text


def parse_trc(content: bytes, name: str) -> RawPoints:
    """The points of a TRC file's bytes; blank cells and zeros are missing, y is up unless the data say otherwise.

    Raises HabitusError where the text is no TRC file or holds no points or frames.
    """
    lines = read_text(content, name).splitlines()
    separator = "\t" if any("\t" in line for line in lines[:5]) else None
    rows = [_cells(line, separator) for line in lines]
    top = next((i for i, row in enumerate(rows[:12]) if row and row[0].strip().lower().startswith("frame")), None)
    if top is None:
        raise HabitusError(f"{name}: not a TRC file (no line begins with 'Frame#'); export it again as TRC")
    header = _header(rows[:top])
    labels, columns = _columns(rows[top], rows[top + 1] if top + 1 < len(rows) else [])
    if not labels:
        raise HabitusError(f"{name}: its 'Frame#' line names no markers; export it again with marker names")
    data = [row for row in rows[top + 1 :] if row and is_count(row[0])]
    if not data:
        raise HabitusError(f"{name}: holds {len(labels)} markers but 0 frames; export it again")
    table = number_table(data, max(columns) + 3, name)
    points = table[:, [column + axis for column in columns for axis in range(3)]].reshape(len(data), -1, 3)
    points, gap_warnings = fill_frames(table[:, 0], points)
    rate, rate_warnings = agreed_rate(number_of(header.get("datarate")), mean_rate(table[:, 1], len(points)))
    return RawPoints(
        format="trc",
        labels=labels,
        points=points,
        rate_hz=rate,
        unit=header.get("units"),
        up_usual="+y",
        warnings=(*rate_warnings, *gap_warnings, *_count_warnings(header, len(labels), len(data))),
    )


def _cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(separator)]


def _header(rows: Sequence[Sequence[str]]) -> dict[str, str]:
    """The names of the line that has DataRate against the values of the line below it."""
    for names, values in pairwise(rows):
        if any(cell.lower() == "datarate" for cell in names):
            return {key.lower(): value for key, value in zip(names, values, strict=False)}
    return {}


def _columns(names: Sequence[str], axes: Sequence[str]) -> tuple[tuple[str, ...], list[int]]:
    """The markers' names and the column of each one's x; names that are not spread over x, y, z stand in order."""
    named = [(i, cell) for i, cell in enumerate(names) if i >= 2 and cell]
    spread = all(later - earlier == 3 for (earlier, _), (later, _) in pairwise(named))
    if not spread or (len(named) == 1 and not axes):
        named = [(2 + 3 * i, cell) for i, (_, cell) in enumerate(named)]
    return tuple(cell for _, cell in named), [i for i, _ in named]


def _count_warnings(header: dict[str, str], markers: int, frames: int) -> list[str]:
    warnings = []
    for key, found, what in (("nummarkers", markers, "markers"), ("numframes", frames, "frames")):
        claimed = number_of(header.get(key))
        if claimed is not None and claimed != found:
            warnings.append(f"the header counts {claimed:g} {what}, the file holds {found}")
    return warnings
