"""TSV exports of Qualisys Track Manager: a header of NAME<tab>value lines, then x, y, z per marker
in millimetres.
"""

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

_MAX_HEADER = 200


def parse_qtm_tsv(content: bytes, name: str) -> RawPoints:
    """The points of a QTM export's bytes; zeros and blank cells are missing.

    Raises HabitusError where the text is no QTM export of 3D points or holds no markers or frames.
    """
    rows = [
        [cell.strip() for cell in line.split("\t")]
        for line in read_text(content, name).splitlines()
    ]
    header = {
        row[0].upper(): row[1:]
        for row in rows[:_MAX_HEADER]
        if len(row) > 1 and row[0].replace("_", "").isalpha()
    }
    labels = tuple(header.get("MARKER_NAMES", []))
    while labels and not labels[-1]:
        labels = labels[:-1]
    if "NO_OF_FRAMES" not in header and not labels:
        raise HabitusError(
            f"{name}: not a QTM export (no NO_OF_FRAMES and MARKER_NAMES lines); export it from "
            "QTM as TSV"
        )
    included = _first(header.get("DATA_INCLUDED"))
    if included and included.upper() != "3D":
        raise HabitusError(
            f"{name}: holds {included} data, not marker positions; export the 3D data from QTM"
        )
    if not labels:
        raise HabitusError(
            f"{name}: its MARKER_NAMES line names no markers; label the markers and export again"
        )
    top = max(i for i, row in enumerate(rows[:_MAX_HEADER]) if row[0].replace("_", "").isalpha())
    data = [row for row in rows[top + 1 :] if any(row)]
    if not data:
        raise HabitusError(f"{name}: holds {len(labels)} markers but 0 frames; export it again")
    return _raw(labels, data, header, name)


def _raw(
    labels: tuple[str, ...], data: list[list[str]], header: dict[str, list[str]], name: str
) -> RawPoints:
    width = 3 * len(labels)
    widths = np.array([_filled(row) for row in data])
    usual = int(np.median(widths))
    extra = usual - width
    if extra not in (0, 1, 2) or (extra and not is_count(data[0][0])):
        raise HabitusError(
            f"{name}: its rows hold {usual} numbers; expected x, y, z of {len(labels)} markers, "
            "after the frame's "
            "number and time at most; export it again"
        )
    table = number_table(data, usual, name)
    points = table[:, extra:].reshape(len(data), len(labels), 3)
    odd = widths != usual
    points[odd] = np.nan
    warnings = [
        f"{odd.sum()} rows hold more or fewer numbers than the markers have: they are missing"
    ] * bool(odd.any())
    points, gap_warnings = fill_frames(table[:, 0], points) if extra else (points, ())
    timed = mean_rate(table[:, 1], len(points)) if extra == 2 else None
    rate, rate_warnings = agreed_rate(number_of(_first(header.get("FREQUENCY"))), timed)
    claimed = number_of(_first(header.get("NO_OF_FRAMES")))
    short = (
        [f"the header counts {claimed:g} frames, the file holds {len(data)}"]
        if claimed not in (None, len(data))
        else []
    )
    return RawPoints(
        format="qtm tsv",
        labels=labels,
        points=points,
        rate_hz=rate,
        unit="mm",
        warnings=(*warnings, *rate_warnings, *gap_warnings, *short),
    )


def _filled(row: list[str]) -> int:
    """Cells of a row without the empty one that a tab at its end makes."""
    return len(row) - (not row[-1])


def _first(cells: list[str] | None) -> str | None:
    return next((cell for cell in cells if cell), None) if cells else None
