"""The index of a folder of results: one HTML page with a row for each capture's report below it."""

import json
import os
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from habitus import __version__
from habitus.errors import HabitusError, shown
from habitus.io.files import atomic_write
from habitus.report.fit.words import LONGEST_NAME

LARGEST_BYTES = 20_000_000
DEEPEST = 3  # folders below: one a capture, one a person or folder of captures above it
_HEADS = ("Capture", "Verdict", "Error", "95 % below", "Frames", "Markers", "Suspects", "Height", "Mass", "Layout")
_LEVELS = ("good", "doubtful", "failed")


def write_index(folder: str | os.PathLike[str]) -> Path | None:
    """Write ``index.html`` in a folder of results, whole or not at all, and return its path; None where it has none.

    Every folder at most three levels below that holds a metrics.json beside a report.html is a row, sorted by path, so
    that the page grows with each run. A metrics.json that cannot be read is a row that says so. Raises HabitusError
    where the page cannot be written.
    """
    root = Path(folder)
    found = sorted(_reports(root, DEEPEST))
    if not found:
        return None
    rows = [_row(place.relative_to(root), _numbers(place / "metrics.json")) for place in found]
    text = Template(_asset("index.html")).substitute(
        version=__version__,
        css=(_asset("page.css") + _asset("index.css")).replace("@dark", _asset("page_dark.css")),
        title=escape(shown(root.resolve().name or "results", LONGEST_NAME)),
        count=f"{len(rows):,} capture{'s' * (len(rows) != 1)}",
        heads="".join(f"<th{_kind(k)} scope='col'>{head}</th>" for k, head in enumerate(_HEADS)),
        rows="\n".join(rows),
    )
    target = root / "index.html"
    with atomic_write(target) as temporary:
        temporary.write_text(text, "utf-8")
    return target


def _reports(folder: Path, depth: int) -> Iterator[Path]:
    """Folders below that hold a report; hidden ones (half-written results) and links to elsewhere are left out."""
    try:
        below = [entry for entry in os.scandir(folder) if entry.is_dir(follow_symlinks=False)]
    except OSError:
        return
    for entry in below:
        place = Path(entry.path)
        if entry.name.startswith("."):
            continue
        if (place / "metrics.json").is_file() and (place / "report.html").is_file():
            yield place
        if depth > 1:
            yield from _reports(place, depth - 1)


def _numbers(path: Path) -> dict[str, Any] | None:
    try:
        if path.stat().st_size > LARGEST_BYTES:
            return None
        numbers = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError, HabitusError):
        return None
    return numbers if isinstance(numbers, dict) else None


def _row(place: Path, numbers: dict[str, Any] | None) -> str:
    name = escape(shown(place, LONGEST_NAME))
    link = f"<th scope='row'><a href='{escape(quote(os.fsencode(place / 'report.html')))}'><bdi>{name}</bdi></a></th>"
    if numbers is None:
        return f"<tr>{link}<td colspan='{len(_HEADS) - 1}' class='unread'>metrics.json cannot be read</td></tr>"
    cells = "".join(f"<td{_kind(k + 1)}>{cell}</td>" for k, cell in enumerate(_cells(numbers)))
    return f"<tr>{link}{cells}</tr>"


def _cells(numbers: dict[str, Any]) -> list[str]:
    errors, body = _table(numbers, "marker_error_mm"), _table(numbers, "body_measurements")
    final = _table(errors, "soft_tissue") or _table(errors, "pose")
    suspects = numbers.get("suspect_markers")
    wrong = (
        [s for s in suspects if isinstance(s, dict) and not s.get("corrected")] if isinstance(suspects, list) else []
    )
    rate = numbers.get("rate_hz")
    at = f" at {rate:g} Hz" if _is_number(rate) else ""
    return [
        _verdict(_table(numbers, "verdict")),
        _number(final.get("mean"), "mm", 1),
        _number(final.get("p95"), "mm", 1),
        _number(numbers.get("frames"), "", 0) + escape(at),
        _number(numbers.get("markers"), "", 0),
        _number(len(wrong), "", 0),
        _number(body.get("height_m"), "cm", 0, 100.0),
        _number(body.get("mass_kg"), "kg", 0),
        escape(shown(numbers.get("layout", ""), LONGEST_NAME)),
    ]


def _verdict(told: dict[str, Any]) -> str:
    level, reasons = told.get("level"), told.get("reasons")
    if level not in _LEVELS:
        return "–"
    why = "; ".join(shown(reason, 300) for reason in reasons) if isinstance(reasons, list) else ""
    return f"<span class='level {level}' title='{escape(why)}'>{level}</span>"


def _table(numbers: dict[str, Any], key: str) -> dict[str, Any]:
    found = numbers.get(key)
    return found if isinstance(found, dict) else {}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e15


def _number(value: Any, unit: str, digits: int, factor: float = 1.0) -> str:
    return f"{factor * value:,.{digits}f}{' ' * bool(unit)}{unit}" if _is_number(value) else "–"


def _kind(column: int) -> str:
    return " class='number'" if 2 <= column < len(_HEADS) - 1 else ""


def _asset(name: str) -> str:
    return files("habitus.report.web").joinpath(name).read_text("utf-8")
