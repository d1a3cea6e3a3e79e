"""The page of an archive: one file that opens offline, with every capture and every subject to sort
and to filter.
"""

import base64
import json
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from habitus.errors import shown
from habitus.files import atomic_write
from habitus.report.facts import LONGEST_NAME, Facts, facts_of
from habitus.report.shell import THEME, asset, shell

MOST_PICTURES = 20_000
"""Captures up to which the page shows pictures of them: it holds some 3 kB for each."""
NOT_FITTED = "not fitted"
_MARK = "@@rows@@"


def write_archive_page(
    path: Path,
    title: str,
    rows: Iterable[Mapping[str, Any]],
    subjects: Sequence[Mapping[str, Any]],
    count: int,
) -> None:
    """Write the page of ``count`` captures, whole or not at all; the rows come one by one and are
    not kept.

    rows: path, person, folder, subject, state, reason, numbers (of metrics.json) and picture (PNG)
    of each. subjects: name, measured, picture. Raises HabitusError where the page cannot be
    written.
    """
    folders = path.parent
    sums: dict[str, _Sum] = defaultdict(_Sum)
    before, middle, after = _page(shown(title or "archive", LONGEST_NAME)).split(_MARK)
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.write(before)
        pictures = count <= MOST_PICTURES
        _write_rows(file, (_capture(row, sums, folders, pictures) for row in rows))
        file.write(middle)
        _write_rows(file, _subjects(subjects, sums))
        file.write(after)


def _page(title: str) -> str:
    """The page, its rows left open."""
    return shell(
        f"{title} · habitus",
        Template(asset("archive.html")).substitute(title=escape(title)),
        arrays={"captures-data": _MARK, "subjects-data": _MARK},
        scripts=(THEME, "archive.js"),
        styles=("index.css", "archive.css"),
        foot="The run that goes on with this archive writes this page anew.",
        without_script="This page needs a script to show its rows; archive.parquet holds the same "
        "numbers.",
    )


class _Sum:
    """What a subject's captures come to."""

    def __init__(self) -> None:
        self.captures = 0
        self.fitted = 0
        self.frames = 0.0
        self.error = 0.0
        self.levels: dict[str, int] = defaultdict(int)

    def add(self, level: str, facts: Facts) -> None:
        self.captures += 1
        self.levels[level] += 1
        if facts.mean_mm is not None:
            self.fitted = self.fitted + 1
            self.frames = self.frames + (facts.frames or 0)
            self.error += facts.mean_mm * (facts.frames or 0)


def _capture(row: Mapping[str, Any], sums: dict[str, _Sum], out: Path, pictures: bool) -> list[Any]:
    """What the page's script is told of a capture, in the order in which it names it."""
    facts = facts_of(row["numbers"])
    done = row["state"] == "done"
    level = facts.level or "" if done else NOT_FITTED
    if row["subject"]:
        sums[row["subject"]].add(level, facts)
    name = row["path"] + (f" · {row['person']}" if row["person"] else "")
    report = Path(row["folder"]) / "report.html"
    link = quote(os.fsencode(report)) if done and (out / report).is_file() else ""
    why = facts.reasons if done else (row["reason"] or "not fitted yet",)
    return [
        shown(name, LONGEST_NAME),
        link,
        shown(row["subject"] or "", LONGEST_NAME),
        level,
        [shown(reason, 300) for reason in why],
        _rounded(facts.mean_mm, 2),
        _rounded(facts.p95_mm, 2),
        facts.frames if done else row["frames"],
        _rounded(facts.rate_hz if done else row["rate_hz"], 3),
        facts.markers,
        facts.suspects if done else None,
        _rounded(facts.height_m, 3),
        _rounded(facts.mass_kg, 1),
        facts.layout,
        _base64(row["picture"]) if pictures else "",
    ]


def _subjects(
    subjects: Sequence[Mapping[str, Any]], sums: Mapping[str, _Sum]
) -> Iterator[list[Any]]:
    told = {one["name"]: one for one in subjects}
    for name in sorted(sums):
        one = told.get(name, {})
        total = sums[name]
        measured = one.get("measured") or {}
        yield [
            shown(name, LONGEST_NAME),
            total.captures,
            total.frames,
            _rounded(total.error / total.frames, 2) if total.frames else None,
            [total.levels[level] for level in ("good", "doubtful", "failed", NOT_FITTED)],
            *(
                _rounded(measured.get(key), 3)
                for key in ("height_m", "mass_kg", "waist_circumference_m")
            ),
            _base64(one.get("picture")),
        ]


def _write_rows(file: Any, rows: Iterator[list[Any]]) -> None:
    """A JSON array inside a page: nothing in it can end the element that holds it."""
    file.write("[")
    for k, row in enumerate(rows):
        text = json.dumps(row, ensure_ascii=False, separators=(",", ":"))
        file.write(",\n" * bool(k) + text.replace("<", "\\u003c"))
    file.write("]")


def _base64(picture: bytes | None) -> str:
    return base64.b64encode(picture).decode() if picture else ""


def _rounded(value: Any, digits: int) -> float | None:
    return round(value, digits) if isinstance(value, (int, float)) else None
