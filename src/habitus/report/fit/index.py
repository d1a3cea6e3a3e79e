"""The index of a folder of results: one HTML page with a row for each capture's report below it."""

import json
import os
from collections.abc import Iterator
from html import escape
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from habitus.errors import HabitusError, shown
from habitus.files import atomic_write
from habitus.report.facts import LONGEST_NAME, Facts, facts_of
from habitus.report.shell import asset, shell

LARGEST_BYTES = 20_000_000
DEEPEST = 3  # folders below: one a capture, one a person or folder of captures above it
_HEADS = (
    "Capture",
    "Verdict",
    "Error",
    "95 % below",
    "Frames",
    "Markers",
    "Suspects",
    "Height",
    "Mass",
    "Layout",
)


def write_index(folder: str | os.PathLike[str]) -> Path | None:
    """Write ``index.html`` in a folder of results, whole or not at all, and return its path; None
    where it has none.

    Every folder at most three levels below that holds a metrics.json beside a report.html is a row,
    sorted by path, so that the page grows with each run. A metrics.json that cannot be read is a
    row that says so. Raises HabitusError where the page cannot be written.
    """
    root = Path(folder)
    found = sorted(_reports(root, DEEPEST))
    if not found:
        return None
    rows = [_row(place.relative_to(root), _numbers(place / "metrics.json")) for place in found]
    title = shown(root.resolve().name or "results", LONGEST_NAME)
    content = Template(asset("index.html")).substitute(
        title=escape(title),
        count=f"{len(rows):,} capture{'s' * (len(rows) != 1)}",
        heads="".join(f"<th{_kind(k)} scope='col'>{head}</th>" for k, head in enumerate(_HEADS)),
        rows="\n".join(rows),
    )
    text = shell(
        f"{title} · habitus",
        content,
        styles=["index.css"],
        foot="Every run that writes here writes this page anew.",
    )
    target = root / "index.html"
    with atomic_write(target) as temporary:
        temporary.write_text(text, "utf-8")
    return target


def _reports(folder: Path, depth: int) -> Iterator[Path]:
    """Folders below that hold a report; hidden ones (half-written results) and links to elsewhere
    are left out.
    """
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
    link = (
        "<th scope='row'><a "
        f"href='{escape(quote(os.fsencode(place / 'report.html')))}'><bdi>{name}</bdi></a></th>"
    )
    if numbers is None:
        return (
            f"<tr>{link}<td colspan='{len(_HEADS) - 1}' class='unread'>metrics.json cannot be "
            "read</td></tr>"
        )
    cells = "".join(f"<td{_kind(k + 1)}>{cell}</td>" for k, cell in enumerate(_cells(numbers)))
    return f"<tr>{link}{cells}</tr>"


def _cells(numbers: dict[str, Any]) -> list[str]:
    facts = facts_of(numbers)
    at = "" if facts.rate_hz is None else f" at {facts.rate_hz:g} Hz"
    return [
        _verdict(facts),
        _number(facts.mean_mm, "mm", 1),
        _number(facts.p95_mm, "mm", 1),
        _number(facts.frames, "", 0) + escape(at),
        _number(facts.markers, "", 0),
        _number(facts.suspects, "", 0),
        _number(facts.height_m, "cm", 0, 100.0),
        _number(facts.mass_kg, "kg", 0),
        escape(facts.layout),
    ]


def _verdict(facts: Facts) -> str:
    if facts.level is None:
        return "–"
    why = "; ".join(facts.reasons)
    return f"<span class='level {facts.level}' title='{escape(why)}'>{facts.level}</span>"


def _number(value: float | None, unit: str, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:,.{digits}f}{' ' * bool(unit)}{unit}"


def _kind(column: int) -> str:
    return " class='number'" if 2 <= column < len(_HEADS) - 1 else ""
