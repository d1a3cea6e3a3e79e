"""CSV exports of OptiTrack Motive, format 1.2x: columns of rigid bodies, bones and markers under a
long header.
"""

import csv
from collections.abc import Sequence

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

_SOLVED = ("Bone Marker", "Rigid Body Marker")


def parse_motive_csv(content: bytes, name: str) -> RawPoints:
    """The ``Marker`` columns of a Motive export's bytes; bones and rigid bodies are left out, blank
    cells are missing.

    Raises HabitusError where the text is no Motive export, or holds only rotations, or no frames.
    """
    text = read_text(content, name)
    try:
        rows = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise HabitusError(
            f"{name}: not a table of comma-separated values ({error}); export it again"
        ) from None
    rows = rows or [[]]
    header = {
        key.strip().lower(): value.strip()
        for key, value in zip(rows[0][::2], rows[0][1::2], strict=False)
    }
    top = next(
        (i for i, row in enumerate(rows[:15]) if row and row[0].strip().lower() == "frame"), None
    )
    if "format version" not in header or top is None:
        raise HabitusError(
            f"{name}: not a Motive export (no 'Format Version' and 'Frame' lines); export it from "
            "Motive as CSV"
        )
    kinds = _line(rows[:top], "type")
    names = _line(rows[:top], "name")
    labels, columns, warnings = _markers(kinds, names, rows[top], rows[top - 1])
    if not labels:
        held = ", ".join(sorted({kind for kind in kinds if kind and kind != "Type"})) or "nothing"
        raise HabitusError(f"{name}: holds no marker columns, only {held}; export it with markers")
    data = [row for row in rows[top + 1 :] if row and is_count(row[0])]
    if not data:
        raise HabitusError(f"{name}: holds {len(labels)} markers but 0 frames; export it again")
    table = number_table(data, max(2, 1 + max(max(place) for place in columns)), name)
    points = table[:, [column for place in columns for column in place]].reshape(len(data), -1, 3)
    claimed = number_of(header.get("export frame rate")) or number_of(
        header.get("capture frame rate")
    )
    points, gap_warnings = fill_frames(table[:, 0], points)
    rate, rate_warnings = agreed_rate(claimed, mean_rate(table[:, 1], len(points)))
    return RawPoints(
        format="motive csv",
        labels=labels,
        points=points,
        rate_hz=rate,
        unit=header.get("length units"),
        up_usual="+y",
        warnings=(*warnings, *rate_warnings, *gap_warnings),
    )


def _line(rows: Sequence[Sequence[str]], title: str) -> list[str]:
    """The header line that has ``title`` in one of its first two cells."""
    for row in rows[1:]:
        if any(cell.strip().lower() == title for cell in row[:2]):
            return [cell.strip() for cell in row]
    return []


def _markers(
    kinds: Sequence[str], names: Sequence[str], axes: Sequence[str], quantities: Sequence[str]
) -> tuple[tuple[str, ...], list[tuple[int, int, int]], list[str]]:
    """Names and (x, y, z) columns of the tracked markers; of the solved ones only where there are
    no tracked ones.
    """
    for wanted in (("Marker",), _SOLVED):
        columns: dict[tuple[str, str], dict[str, int]] = {}
        for i in range(2, min(len(kinds), len(names), len(axes))):
            axis = axes[i].strip().upper()
            position = i >= len(quantities) or quantities[i].strip() in ("Position", "")
            if kinds[i] in wanted and axis in ("X", "Y", "Z") and position:
                block = i - "XYZ".index(axis)
                columns.setdefault((names[i], str(block)), {})[axis] = i
        whole = {key: place for key, place in columns.items() if len(place) == 3}
        if whole:
            solved = [
                "the file holds no tracked markers: the solved ones of its bones are used"
            ] * (wanted == _SOLVED)
            return (
                tuple(key[0] for key in whole),
                [(p["X"], p["Y"], p["Z"]) for p in whole.values()],
                solved,
            )
    return (), [], []
