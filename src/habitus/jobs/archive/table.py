"""Whose captures are whose, by a table that a person wrote."""

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path, PurePosixPath

from habitus.errors import HabitusError, shown
from habitus.io.names import plain_name

COLUMNS = ("capture", "subject")
_DELIMITERS = ",;\t"


@dataclass(frozen=True)
class SubjectsTable:
    """Subjects of files and folders, by their paths below the archive's folder."""

    subjects: dict[PurePosixPath, str]

    def subject(self, path: Path) -> str | None:
        """Of a file, by its path relative to the folder: by its own row, else that of the nearest
        folder that has one.

        A row may leave the file's ending out.
        """
        where = PurePosixPath(path.as_posix())
        for place in (where, where.with_suffix(""), *where.parents):
            if place in self.subjects:
                return self.subjects[place]
        return None


def read_subjects(path: Path, files: Iterable[Path]) -> SubjectsTable:
    """A table (CSV with the columns capture and subject, separated by commas, semicolons or tabs)
    of these files.

    A row's capture is a file or a folder, relative to the archive's folder. Raises HabitusError,
    naming the line, for a row of which there is neither, one without a subject, and two that
    differ.
    """
    rows = _rows(path)
    known = {place for file in files for place in _names(PurePosixPath(file.as_posix()))}
    subjects: dict[PurePosixPath, str] = {}
    for line, row in rows:
        capture, subject = ((row.get(column) or "").strip() for column in COLUMNS)
        place = PurePosixPath(capture.replace("\\", "/"))
        if not capture or not subject:
            lacking = COLUMNS[0] if not capture else COLUMNS[1]
            raise HabitusError(
                f"{path}: line {line} has no {lacking}; expected a capture or folder and whose it "
                "is"
            )
        if place not in known:
            near = get_close_matches(str(place), [str(one) for one in known], n=1)
            hint = (
                f"did you mean {near[0]}?"
                if near
                else "expected paths relative to the archive's folder"
            )
            raise HabitusError(
                f"{path}: line {line} names {shown(capture)}, which is no capture or folder "
                f"there; {hint}"
            )
        if subjects.setdefault(place, plain_name(subject)) != plain_name(subject):
            raise HabitusError(
                f"{path}: line {line} gives {shown(capture)} to a second subject; expected one "
                "row for it"
            )
    return SubjectsTable(subjects)


def _names(file: PurePosixPath) -> tuple[PurePosixPath, ...]:
    return (file, file.with_suffix(""), *file.parents)


def _rows(path: Path) -> list[tuple[int, dict[str, str]]]:
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise HabitusError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}); check the path"
        ) from error
    head = text.partition("\n")[0]
    delimiter = max(_DELIMITERS, key=head.count)
    reader = csv.DictReader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)
    columns = [name.strip().lower() for name in reader.fieldnames or ()]
    if not set(COLUMNS) <= set(columns):
        raise HabitusError(
            f"{path}: its first line reads {shown(head)!r}; expected the columns "
            f"{' and '.join(COLUMNS)}"
        )
    reader.fieldnames = columns
    return [
        (reader.line_num, row)
        for row in reader
        if any(isinstance(x, str) and x.strip() for x in row.values())
    ]
