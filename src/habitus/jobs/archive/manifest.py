"""What is known of an archive's captures and subjects, in one SQLite file that survives a kill at
any moment.
"""

import json
import sqlite3
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.io.limits import Allowance, check_inflated, read_json
from habitus.io.names import file_name, inside
from habitus.jobs.archive.items import FileContent, Fitted, Seen, Shaped
from habitus.jobs.finding import CaptureFile, MarkerSet

FILE = "archive.sqlite"
VERSION = 2
DONE = "done"
FAILED = "failed"
WAITING = "waiting"
_TABLES = """
CREATE TABLE files (path TEXT PRIMARY KEY, size INTEGER, changed INTEGER, digest TEXT, state TEXT, reason TEXT);
CREATE TABLE captures (
    path TEXT, person TEXT, folder TEXT, name_in_file TEXT, frames INTEGER, rate_hz REAL, marker_set BLOB, subject TEXT,
    state TEXT, key TEXT, reason TEXT, numbers TEXT, picture BLOB, seconds REAL, PRIMARY KEY (path, person));
CREATE TABLE subjects (
    name TEXT PRIMARY KEY, file TEXT, recipe TEXT, sources TEXT, digest TEXT, reason TEXT, measured TEXT, betas TEXT,
    picture BLOB, seconds REAL);
CREATE INDEX captures_of ON captures (subject);
"""  # noqa: E501


@dataclass(frozen=True)
class Row:
    """A capture as the manifest has it: the file's path below the archive's folder, who in it,
    where its results go.
    """

    path: str
    person: str
    folder: str
    frames: int
    subject: str
    state: str
    key: str
    digest: str


class Manifest:
    """The manifest of a folder of results. What is written is on the disk when a method returns."""

    def __init__(self, connection: sqlite3.Connection):
        self._db = connection

    # -- files -------------------------------------------------------------------------------------

    def stamps(self) -> dict[str, tuple[int, int, str]]:
        """Size, time of the last change and state of every file that was read."""
        rows = self._db.execute("SELECT path, size, changed, state FROM files")
        return {path: (size, changed, state) for path, size, changed, state in rows}

    def record_file(
        self, path: str, stamp: tuple[int, int], content: FileContent, folders: Sequence[str]
    ) -> None:
        """What a file holds, in the place of what was known of it; results whose input is the same
        stay.
        """
        state = "left out" if content.no_capture else FAILED if content.reason else DONE
        with self._db:
            self._db.execute(
                "INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?, ?, ?)",
                (path, *stamp, content.digest, state, content.reason),
            )
            names = _names(content.people)
            kept = ",".join("?" * len(names))
            self._db.execute(
                f"DELETE FROM captures WHERE path = ? AND person NOT IN ({kept})", (path, *names)
            )
            for name, folder, seen in zip(names, folders, content.people, strict=True):
                row = (folder, seen.subject, seen.frames, seen.rate_hz, _packed(seen.markers))
                self._db.execute(
                    "INSERT INTO captures (path, person, folder, name_in_file, frames, rate_hz, "
                    "marker_set, subject, state, key) "
                    f"VALUES (?, ?, ?, ?, ?, ?, ?, '', '{WAITING}', '') ON CONFLICT (path, "
                    "person) DO UPDATE SET "
                    "folder = excluded.folder, name_in_file = excluded.name_in_file, "
                    "frames = excluded.frames, rate_hz = excluded.rate_hz, "
                    "marker_set = excluded.marker_set",
                    (path, name, *row),
                )

    def forget(self, paths: Sequence[str]) -> None:
        """Files that are gone."""
        with self._db:
            for table in ("files", "captures"):
                self._db.executemany(
                    f"DELETE FROM {table} WHERE path = ?", [(path,) for path in paths]
                )

    # -- captures ----------------------------------------------------------------------------------

    def marker_sets(self) -> Iterator[tuple[str, str, MarkerSet]]:
        """Path, person and marker set of every capture, in the order of their paths."""
        rows = self._db.execute(
            "SELECT path, person, name_in_file, marker_set FROM captures ORDER BY path, person"
        )
        for path, person, name, packed in rows:
            with _readable():
                entry = str(path), str(person), _unpacked(name, packed)
            yield entry

    def group(self, groups: Mapping[tuple[str, str], str]) -> None:
        """Whose each capture (path, person) is."""
        with self._db:
            self._db.executemany(
                "UPDATE captures SET subject = ? WHERE path = ? AND person = ?",
                [(subject, *key) for key, subject in groups.items()],
            )
            self._db.execute(
                "DELETE FROM subjects WHERE name NOT IN (SELECT DISTINCT subject FROM captures)"
            )

    def captures(self, subject: str | None = None) -> list[Row]:
        """All captures, or those of a subject, in the order of their paths."""
        clause, given = ("", ()) if subject is None else ("WHERE subject = ?", (subject,))
        rows = self._db.execute(
            "SELECT path, person, folder, frames, subject, captures.state, key, digest "
            f"FROM captures JOIN files USING (path) {clause} ORDER BY path, person",
            given,
        )
        with _readable():
            return [_row(*row) for row in rows]

    def fitted(self, row: Row, key: str, result: Fitted) -> None:
        """What came of a capture; ``key`` stands for all that it depends on."""
        state = FAILED if result.reason else DONE
        numbers = json.dumps(result.numbers, ensure_ascii=False) if result.numbers else None
        self._set(row, (state, key, result.reason, numbers, result.picture, result.seconds))

    def failed(self, row: Row, reason: str) -> None:
        """A capture that cannot be fitted."""
        self._set(row, (FAILED, "", reason, None, None, None))

    def _set(self, row: Row, values: tuple[Any, ...]) -> None:
        with self._db:
            self._db.execute(
                "UPDATE captures SET state = ?, key = ?, reason = ?, numbers = ?, picture = ?, "
                "seconds = ? "
                "WHERE path = ? AND person = ?",
                (*values, row.path, row.person),
            )

    # -- subjects ----------------------------------------------------------------------------------

    def subject(self, name: str) -> tuple[str, str, dict[str, str], str] | None:
        """File, recipe, the digests of the captures that gave frames, and digest of a subject's
        shape.
        """
        row = self._db.execute(
            "SELECT file, recipe, sources, digest FROM subjects WHERE name = ?", (name,)
        ).fetchone()
        with _readable():
            return row and (str(row[0]), str(row[1]), _table(row[2]), str(row[3]))

    def shaped(
        self, name: str, file: str, recipe: str, sources: Mapping[str, str], shape: Shaped
    ) -> None:
        """A subject's shape."""
        values = (
            json.dumps(sources),
            shape.digest,
            shape.reason,
            json.dumps(shape.measured),
            json.dumps(shape.betas),
        )
        with self._db:
            self._db.execute(
                "INSERT OR REPLACE INTO subjects VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (name, file, recipe, *values, shape.picture, shape.seconds),
            )

    # -- what became of all ------------------------------------------------------------------------

    def results(self) -> Iterator[dict[str, Any]]:
        """Every capture and every file that could not be read, in the order of their paths, as the
        page and the table have them.
        """
        self._db.row_factory, before = sqlite3.Row, self._db.row_factory
        try:
            rows = self._db.execute(
                "SELECT path, person, folder, subject, frames, rate_hz, state, reason, numbers, "
                "picture, seconds "
                "FROM captures UNION ALL SELECT path, '', '', '', NULL, NULL, state, reason, "
                "NULL, NULL, NULL "
                f"FROM files WHERE state = '{FAILED}' ORDER BY path, person"
            )
            for row in rows:
                with _readable():
                    result = dict(row) | {"numbers": _table(row["numbers"] or "{}")}
                yield result
        finally:
            self._db.row_factory = before

    def people(self) -> list[dict[str, Any]]:
        """Every subject, in the order of their names."""
        rows = self._db.execute(
            "SELECT name, reason, measured, betas, picture, seconds FROM subjects ORDER BY name"
        )
        keys = ("name", "reason", "measured", "betas", "picture", "seconds")
        people = [dict(zip(keys, row, strict=True)) for row in rows]
        with _readable():
            return [
                person | {"measured": _table(person["measured"]), "betas": _list(person["betas"])}
                for person in people
            ]

    def count(self) -> int:
        """How many rows `results` has."""
        sql = (
            "SELECT (SELECT COUNT(*) FROM captures) + (SELECT COUNT(*) FROM files WHERE state "
            f"= '{FAILED}')"
        )
        return self._db.execute(sql).fetchone()[0]

    def left_out(self) -> int:
        """How many files are no captures."""
        return self._db.execute("SELECT COUNT(*) FROM files WHERE state = 'left out'").fetchone()[0]


@contextmanager
def open_manifest(folder: Path) -> Iterator[Manifest]:
    """The manifest of a folder of results, made if need be; nobody else may be at work in the
    folder.

    Raises HabitusError for a file that is none, or of another version.
    """
    path = folder / FILE
    connection = None
    try:
        connection = sqlite3.connect(path)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version == 0:
            connection.executescript(f"BEGIN; {_TABLES} PRAGMA user_version = {VERSION}; COMMIT;")
        elif version != VERSION:
            raise HabitusError(
                f"{path}: is of another version of habitus; choose another folder with --out"
            )
        yield Manifest(connection)
    except (sqlite3.Error, UnicodeDecodeError) as error:  # damaged pages, damaged texts in them
        raise HabitusError(
            f"{path}: {shown(error, 160)}; free some room, or remove the file to start again"
        ) from error
    finally:
        if connection is not None:
            connection.close()


@contextmanager
def _readable() -> Iterator[None]:
    """Around what rows of a damaged manifest may raise: its columns can hold values of any type."""
    try:
        yield
    except (ValueError, TypeError, KeyError, IndexError, zlib.error, RecursionError) as error:
        raise HabitusError(
            f"{FILE}: its rows cannot be read ({shown(error, 80)}); remove the file to start again"
        ) from error


def _row(path: Any, person: Any, folder: Any, frames: Any, *words: Any) -> Row:
    if not all(isinstance(word, str) for word in (path, person, folder, *words)):
        raise TypeError("a column of another type")
    return Row(path, person, inside(folder).as_posix(), int(frames), *words)


def _table(text: str) -> dict[str, Any]:
    table = read_json(text)
    if not isinstance(table, dict):
        raise TypeError("a column that is no table")
    return table


def _list(text: str) -> list[Any]:
    entries = read_json(text)
    if not isinstance(entries, list):
        raise TypeError("a column that is no list")
    return entries


def folder_names(file: CaptureFile, people: Sequence[Seen]) -> list[str]:
    """The folders of the results of everybody in a file, below the folder for all."""
    name = file_name(file.name)
    names = (
        [name]
        if len(people) == 1
        else [file_name(f"{name}_{each or 'unnamed'}") for each in _names(people)]
    )
    return [(file.place / each).as_posix() for each in names]


def _names(people: Sequence[Seen]) -> list[str]:
    """What tells people of a file apart: nothing where there is one."""
    return [""] if len(people) == 1 else [person.subject or "" for person in people]


def _packed(markers: MarkerSet) -> bytes:
    upper = markers.rigid[np.triu_indices(len(markers.labels), 1)].astype(np.float32)
    return zlib.compress(json.dumps(markers.labels).encode() + b"\0" + upper.tobytes())


def _unpacked(subject: str | None, packed: bytes) -> MarkerSet:
    check_inflated(packed, Allowance(len(packed)).limit, "the markers of a capture")
    head, _, tail = zlib.decompress(packed).partition(b"\0")
    labels = tuple(str(label) for label in read_json(head.decode()))
    if len(tail) != 4 * (len(labels) * (len(labels) - 1) // 2):
        raise ValueError("distances of another number of markers")
    rigid = np.full((len(labels), len(labels)), np.nan)
    rigid[np.triu_indices(len(labels), 1)] = np.frombuffer(tail, np.float32)
    return MarkerSet(subject, labels, rigid)
