"""Subjects of an archive's captures: by a table, else by the file's subject and folder, and by the
placements of markers.
"""

import csv
import io
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path, PurePosixPath

from habitus.errors import HabitusError, shown
from habitus.io.limits import read_file
from habitus.io.names import plain_name
from habitus.jobs.finding import MarkerSet

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
            near = get_close_matches(str(place), [str(each) for each in known], n=1)
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
        text = read_file(path).decode("utf-8-sig")
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


Key = tuple[str, str]
"""A capture: its file's path below the archive's folder, and who in it ("" where there is one
person).
"""


def grouped_by_subject(
    captures: Iterable[tuple[str, str, MarkerSet]], table: SubjectsTable | None, top: str
) -> dict[Key, str]:
    """The subject of each capture, given in the order of their paths; ``top`` is what the folder of
    all is called.

    A table's subject is one wherever the captures lie; else those of one folder that name one
    subject are. Of either, captures whose markers sit elsewhere are parted, as "ann (2)": one shape
    stage places each marker once. Where marker sets cannot tell, a table is believed, and a
    folder is not.
    """
    heads: dict[str, list[MarkerSet]] = defaultdict(list)
    subjects: dict[Key, str] = {}
    for path, person, seen in captures:
        given = table.subject(Path(path)) if table is not None and not person else None
        name = given or _folder_name(path, seen.subject, top)
        kin = heads[name]
        number = next(
            (
                k
                for k, head in enumerate(kin)
                if (not head.differs(seen) if given else head.matches(seen))
            ),
            None,
        )
        if number is None:
            number = len(kin)
            kin.append(seen)
        subjects[path, person] = name if number == 0 else f"{name} ({number + 1})"
    return subjects


def _folder_name(path: str, subject: str | None, top: str) -> str:
    folder = PurePosixPath(path).parent.as_posix()
    return "/".join(filter(None, ["" if folder == "." else folder, subject or ""])) or top
