"""What an archive shows of itself: one page that opens offline with every capture and subject to
sort and to filter, one Parquet table with all numbers, and small pictures of people and motions.
"""

import base64
import json
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Float, Int, UInt8

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.errors import require_extra, shown
from habitus.export.png import small_png
from habitus.files import atomic_write
from habitus.report.drawing import axes_from, draw_surface, shade_palette, shades
from habitus.report.index import LEVELS, Facts, facts_of
from habitus.report.shell import MAX_NAME, MAX_REASON, THEME, asset, shell
from habitus.rotations import matrix_from_rotvec, up_rotation

MAX_PICTURES = 20_000
"""Captures up to which the page shows pictures of them: it holds some 3 kB for each."""
NOT_FITTED = "not fitted"
_MARK = "@@rows@@"
HEIGHT, STEP, MARGIN = 84, 46, 16
"""Pixels: height of a picture, distance from one moment to the next, and margin on both sides."""
MOMENTS = 4
"""Moments of a motion that are shown."""
METRES = 2.05
"""Metres that the height shows; a motion that needs more is shown smaller."""
_TURN = np.radians(35.0)  # of the view, from the person's front to the left
_COLUMNS = {
    "capture": "VARCHAR",
    "person": "VARCHAR",
    "subject": "VARCHAR",
    "state": "VARCHAR",
    "reason": "VARCHAR",
    "folder": "VARCHAR",
}
_MAPS = ("per_marker",)
_SUSPECTS = "STRUCT(label VARCHAR, reason VARCHAR, frames BIGINT, corrected BOOLEAN)[]"
_TYPES = {bool: "BOOLEAN", int: "DOUBLE", float: "DOUBLE", str: "VARCHAR"}


def write_archive_page(
    path: Path,
    title: str,
    rows: Iterable[Mapping[str, Any]],
    subjects: Sequence[Mapping[str, Any]],
    count: int,
) -> None:
    """Write the page of ``count`` captures atomically; rows are read one by one and not kept.

    rows: path, person, folder, subject, state, reason, numbers (of metrics.json) and picture (PNG)
    of each. subjects: name, measured, picture. Raises HabitusError where the page cannot be
    written.
    """
    folders = path.parent
    sums: dict[str, _Sum] = defaultdict(_Sum)
    before, middle, after = _page(shown(title or "archive", MAX_NAME)).split(_MARK)
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.write(before)
        pictures = count <= MAX_PICTURES
        _write_rows(file, (_capture(row, sums, folders, pictures) for row in rows))
        file.write(middle)
        _write_rows(file, _subjects(subjects, sums))
        file.write(after)


def _page(title: str) -> str:
    """The page with _MARK in place of its rows."""
    return shell(
        f"{title} · habitus",
        Template(asset("archive.html")).substitute(title=escape(title)),
        arrays={"captures-data": _MARK, "subjects-data": _MARK},
        scripts=(THEME, "archive.js"),
        styles=("index.css", "archive.css"),
        foot="Every run that continues this archive rewrites this page.",
        without_script="The rows need JavaScript; archive.parquet has the same numbers.",
    )


class _Sum:
    """Sums over a subject's captures."""

    def __init__(self) -> None:
        self.captures = 0
        self.frames = 0.0
        self.error = 0.0
        self.levels: dict[str, int] = defaultdict(int)

    def add(self, level: str, facts: Facts) -> None:
        self.captures += 1
        self.levels[level] += 1
        if facts.mean_mm is not None:
            self.frames += facts.frames or 0
            self.error += facts.mean_mm * (facts.frames or 0)


def _capture(row: Mapping[str, Any], sums: dict[str, _Sum], out: Path, pictures: bool) -> list[Any]:
    """A row of the table of captures, in the order of the columns of archive.js."""
    facts = facts_of(row["numbers"])
    done = row["state"] == "done"
    level = facts.level or "" if done else NOT_FITTED
    if row["subject"]:
        sums[row["subject"]].add(level, facts)
    name = row["path"] + (f" · {row['person']}" if row["person"] else "")
    report = Path(row["folder"]) / "report.html"
    link = quote(os.fsencode(report.as_posix())) if done and (out / report).is_file() else ""
    reasons = facts.reasons if done else (row["reason"] or "not fitted yet",)
    return [
        shown(name, MAX_NAME),
        link,
        shown(row["subject"] or "", MAX_NAME),
        level,
        [shown(reason, MAX_REASON) for reason in reasons],
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
    """Rows of the table of subjects, in the order of the columns of archive.js."""
    by_name = {subject["name"]: subject for subject in subjects}
    for name in sorted(sums):
        subject = by_name.get(name, {})
        total = sums[name]
        measured = subject.get("measured") or {}
        yield [
            shown(name, MAX_NAME),
            total.captures,
            total.frames,
            _rounded(total.error / total.frames, 2) if total.frames else None,
            [total.levels[level] for level in (*LEVELS, NOT_FITTED)],
            *(
                _rounded(measured.get(key), 3)
                for key in ("height_m", "mass_kg", "waist_circumference_m")
            ),
            _base64(subject.get("picture")),
        ]


def _write_rows(file: Any, rows: Iterator[list[Any]]) -> None:
    """A JSON array inside a script element, which nothing in it can end."""
    file.write("[")
    for k, row in enumerate(rows):
        text = json.dumps(row, ensure_ascii=False, separators=(",", ":"))
        file.write(",\n" * bool(k) + text.replace("<", "\\u003c"))
    file.write("]")


def _base64(picture: bytes | None) -> str:
    return base64.b64encode(picture).decode() if picture else ""


def _rounded(value: Any, digits: int) -> float | None:
    return round(value, digits) if isinstance(value, (int, float)) else None


def write_table(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write the rows of a manifest as Parquet, atomically; nested values of metrics.json become
    columns ``a.b.c``.

    Numbers are doubles, errors of markers maps by label, suspects lists of structures. Raises
    HabitusError where duckdb is not installed.
    """
    duckdb = require_extra("duckdb", "tables of an archive", "archive")
    types = dict(_COLUMNS)
    with tempfile.TemporaryDirectory() as folder, atomic_write(path) as target:
        lines = Path(folder) / "rows.ndjson"
        with lines.open("w", encoding="utf-8", newline="\n") as file:
            for row in rows:
                flat = _flat_row(row)
                for name, value in flat.items():
                    types.setdefault(name, _type(name, value))
                file.write(json.dumps(flat) + "\n")
        columns = (
            "{"
            + ", ".join(f"{_quoted(name)}: {_quoted(kind)}" for name, kind in types.items())
            + "}"
        )
        read = (
            f"read_json({_quoted(str(lines))}, format = 'newline_delimited', columns = {columns})"
        )
        settings = {
            "autoinstall_known_extensions": False,
            "autoload_known_extensions": False,
            "threads": 1,
        }
        with duckdb.connect(config=settings) as connection:
            connection.execute(
                f"COPY (FROM {read}) TO {_quoted(str(target))} (FORMAT parquet, COMPRESSION zstd)"
            )


def _flat_row(row: Mapping[str, Any]) -> dict[str, Any]:
    numbers = {name: value for name, value in row["numbers"].items() if name != "capture"}
    first = {name: row.get("path" if name == "capture" else name) for name in _COLUMNS}
    return first | {name: value for name, value in _flat(numbers, "") if value is not None}


def _flat(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and name.rpartition(".")[2] not in _MAPS:
        for key, inner in value.items():
            yield from _flat(inner, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def _type(name: str, value: Any) -> str:
    if isinstance(value, Mapping):
        return "MAP(VARCHAR, DOUBLE)"
    if isinstance(value, list):
        return _SUSPECTS if name == "suspect_markers" else "VARCHAR[]"
    return _TYPES[type(value)]


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def palette() -> UInt8[np.ndarray, "16 3"]:
    """Transparent, then fifteen shades of skin from dark to pale."""
    return shade_palette(dark=(58, 50, 46), pale=(226, 212, 194))


def motion_picture(moving: Moving) -> bytes:
    """A PNG of `MOMENTS` moments of a motion on one floor, seen from the person's front left."""
    frames = np.linspace(0, moving.num_frames - 1, 2 * MOMENTS + 1)[1::2].round().astype(int)
    turn = up_rotation(moving.up_axis)
    root = np.asarray(matrix_from_rotvec(moving.pose[int(frames[MOMENTS // 2]), 0]))
    ahead = turn @ root @ np.array([0.0, 0.0, 1.0])
    axes = _axes(np.arctan2(ahead[0], ahead[2]) - _TURN)
    bodies = moving.vertices(list(frames)) @ turn.T @ axes.T
    levels = np.zeros((HEIGHT, STEP * (MOMENTS - 1) + 2 * (MARGIN + STEP // 2)), np.uint8)
    floor = float(bodies[..., 1].min())
    scale = HEIGHT / max(METRES, 1.02 * (float(bodies[..., 1].max()) - floor))
    for k, body in enumerate(bodies):
        column = MARGIN + STEP // 2 + k * STEP
        _draw(levels, body, np.asarray(moving.body.faces), floor, scale, column)
    return small_png(levels, palette())


def shape_picture(body: BodyModel, betas: Float[np.ndarray, " B"]) -> bytes:
    """A PNG of a person at rest, seen from the front left."""
    rest = np.asarray(body.rest_vertices(betas)) @ _axes(-_TURN / 2).T
    levels = np.zeros((HEIGHT, HEIGHT), np.uint8)
    scale = HEIGHT / max(METRES, 1.02 * float(np.ptp(rest[:, 1])))
    _draw(levels, rest, np.asarray(body.faces), float(rest[:, 1].min()), scale, HEIGHT // 2)
    return small_png(levels, palette())


def _axes(angle: float) -> Float[np.ndarray, "3 3"]:
    """The view from where this angle from +z about +y points."""
    return axes_from((np.sin(angle), 0.0, np.cos(angle)))


def _draw(
    levels: UInt8[np.ndarray, "H W"],
    points: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    floor: float,
    scale: float,
    column: int,
) -> None:
    """Draw a surface (m, in the axes of the view) over ``levels``, its middle at ``column``;
    ``floor`` is the height (m) of the lowest row, ``scale`` pixels a metre.
    """
    middle = 0.5 * (points[:, 0].min() + points[:, 0].max())
    height, width = levels.shape
    placed = (points - [middle, floor, 0.0]) * scale * [1.0, -1.0, 1.0] + [column, height, 0.0]
    drawn = shades(draw_surface(placed, faces, np.ones_like(points), width, height))
    levels[:] = np.where(drawn > 0, drawn, levels)
