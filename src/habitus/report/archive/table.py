"""All numbers of an archive as one Parquet table: a row a capture, a column a number of
metrics.json.
"""

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from habitus.errors import require_extra
from habitus.files import atomic_write

_FIRST = {
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


def write_table(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows of a manifest as Parquet, whole or not at all; what metrics.json nests becomes
    ``a.b.c``.

    Numbers are doubles, errors by marker maps of labels, suspects lists of structures. Raises
    HabitusError where duckdb is not installed.
    """
    duckdb = require_extra("duckdb", "tables of an archive", "archive")
    types = dict(_FIRST)
    with tempfile.TemporaryDirectory() as folder, atomic_write(path) as target:
        lines = Path(folder) / "rows.ndjson"
        with lines.open("w", encoding="utf-8") as file:
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
    told = {name: row.get("path" if name == "capture" else name) for name in _FIRST}
    return told | {name: value for name, value in _flat(numbers, "") if value is not None}


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
