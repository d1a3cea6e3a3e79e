"""The index of a folder of results: one HTML page with a row for each capture's report below it.

`Facts` is what an index shows of a capture, read from its metrics.json, whatever that holds.
"""

import json
import os
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NamedTuple
from urllib.parse import quote

from habitus.errors import HabitusError, shown
from habitus.files import atomic_write
from habitus.report.shell import MAX_NAME, MAX_REASON, asset, shell

LEVELS = ("good", "doubtful", "failed")
MAX_BYTES = 20_000_000
"""A larger metrics.json is not read: it is none that a fit has written."""
MAX_DEPTH = 3
"""Folders below the index: one a capture, one or two for people or folders of captures."""
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


class Facts(NamedTuple):
    """Verdict and its reasons, error of the last stage (mm), the capture and the person; None where
    metrics.json does not say.
    """

    level: str | None
    reasons: tuple[str, ...]
    mean_mm: float | None
    p95_mm: float | None
    frames: float | None
    rate_hz: float | None
    markers: float | None
    suspects: int
    height_m: float | None
    mass_kg: float | None
    layout: str


def facts_of(numbers: Mapping[str, Any]) -> Facts:
    """The facts of one capture; values of a wrong type count as missing."""
    errors, body, verdict = (
        _table(numbers, key) for key in ("marker_error_mm", "body_measurements", "verdict")
    )
    final = _table(errors, "soft_tissue") or _table(errors, "pose")
    suspects = numbers.get("suspect_markers")
    reasons = verdict.get("reasons")
    listed = suspects if isinstance(suspects, list) else []
    return Facts(
        verdict["level"] if verdict.get("level") in LEVELS else None,
        tuple(shown(reason, MAX_REASON) for reason in reasons) if isinstance(reasons, list) else (),
        number(final.get("mean")),
        number(final.get("p95")),
        number(numbers.get("frames")),
        number(numbers.get("rate_hz")),
        number(numbers.get("markers")),
        sum(isinstance(entry, dict) and not entry.get("corrected") for entry in listed),
        number(body.get("height_m")),
        number(body.get("mass_kg")),
        shown(numbers.get("layout", ""), MAX_NAME),
    )


def number(value: Any) -> float | None:
    """The value where it is a number that can be shown, else None."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return value if is_number and abs(value) < 1e15 else None


def _table(numbers: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    table = numbers.get(key)
    return table if isinstance(table, dict) else {}


def write_index(folder: str | os.PathLike[str]) -> Path | None:
    """Write ``index.html`` in a folder of results, atomically, and return its path; None where
    there are no reports.

    Every folder at most ``MAX_DEPTH`` levels below that holds metrics.json and report.html becomes
    a row, sorted by path, so that the page grows with each run. A metrics.json that cannot be read
    becomes a row that says so. Raises HabitusError where the page cannot be written.
    """
    root = Path(folder)
    reports = sorted(_reports(root, MAX_DEPTH))
    if not reports:
        return None
    rows = [_row(place.relative_to(root), _numbers(place / "metrics.json")) for place in reports]
    title = shown(root.resolve().name or "results", MAX_NAME)
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
        foot="Every run that writes into this folder rewrites this page.",
    )
    target = root / "index.html"
    with atomic_write(target) as temporary:
        temporary.write_text(text, "utf-8")
    return target


def _reports(folder: Path, depth: int) -> Iterator[Path]:
    """Folders below that hold a report, without hidden ones (half-written results) and symbolic
    links.
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
        if path.stat().st_size > MAX_BYTES:
            return None
        numbers = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError, HabitusError):
        return None
    return numbers if isinstance(numbers, dict) else None


def _row(place: Path, numbers: dict[str, Any] | None) -> str:
    name = escape(shown(place, MAX_NAME))
    page = quote(os.fsencode((place / "report.html").as_posix()))
    link = f"<th scope='row'><a href='{escape(page)}'><bdi>{name}</bdi></a></th>"
    if numbers is None:
        return (
            f"<tr>{link}<td colspan='{len(_HEADS) - 1}' class='unread'>metrics.json cannot be "
            "read</td></tr>"
        )
    cells = "".join(f"<td{_kind(k + 1)}>{cell}</td>" for k, cell in enumerate(_cells(numbers)))
    return f"<tr>{link}{cells}</tr>"


def _cells(numbers: dict[str, Any]) -> list[str]:
    facts = facts_of(numbers)
    rate = "" if facts.rate_hz is None else f" at {facts.rate_hz:g} Hz"
    return [
        _verdict(facts),
        _number(facts.mean_mm, "mm", 1),
        _number(facts.p95_mm, "mm", 1),
        _number(facts.frames, "", 0) + escape(rate),
        _number(facts.markers, "", 0),
        _number(facts.suspects, "", 0),
        _number(facts.height_m, "cm", 0, 100.0),
        _number(facts.mass_kg, "kg", 0),
        escape(facts.layout),
    ]


def _verdict(facts: Facts) -> str:
    if facts.level is None:
        return "–"
    reasons = "; ".join(facts.reasons)
    return f"<span class='level {facts.level}' title='{escape(reasons)}'>{facts.level}</span>"


def _number(value: float | None, unit: str, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:,.{digits}f}{' ' * bool(unit)}{unit}"


def _kind(column: int) -> str:
    return " class='number'" if 2 <= column < len(_HEADS) - 1 else ""
