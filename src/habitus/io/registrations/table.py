"""The table ``registrations.csv``: the subject of each registration."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from habitus.errors import HabitusError, shown
from habitus.io.captures.tables import read_text
from habitus.io.limits import check_text, read_file
from habitus.io.names import plain_name
from habitus.io.units import METRES, unit_of
from habitus.mesh.registrations import SETS, VERDICTS

COLUMNS = ("file", "subject", "sex", "set", "unit", "frame", "name", "verdict")
_SEXES = {
    "female": "female",
    "f": "female",
    "woman": "female",
    "w": "female",
    "male": "male",
    "m": "male",
}
_SEXES |= {"man": "male", "": "", "neutral": "", "unknown": "", "-": ""}
_SPELLINGS = {
    "gender": "sex",
    "units": "unit",
    "id": "subject",
    "split": "set",
    "filename": "file",
    "path": "file",
}


def read_table(path: Path) -> dict[str, tuple[str, ...]]:
    """The columns of a table that are known, by name, a word a row; ``sex``, ``set`` and ``unit``
    in one spelling.

    A comma, a semicolon or a tab parts the cells. Raises HabitusError, naming the line, where a row
    tells no subject or a word that is not known.
    """
    try:
        check_text(path.stat().st_size, str(path))
        text = read_text(read_file(path), str(path))
    except OSError as error:
        raise HabitusError(
            f"{path}: {error.strerror or error}; expected a table of registrations"
        ) from error
    head = text.strip().splitlines()[0]
    mark = max(",;\t", key=head.count)
    try:
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=mark, strict=True))
    except csv.Error as error:
        raise HabitusError(
            f"{path}: no table ({error}); expected cells parted by commas"
        ) from error
    names = [
        _SPELLINGS.get(word, word) for word in (cell.strip().lower() for cell in (rows or [[]])[0])
    ]
    known = [name for name in names if name in COLUMNS]
    if "subject" not in known or len(set(known)) < len(known):
        raise HabitusError(
            f"{path}: its columns are {shown(', '.join(names))!r}; expected each of "
            f"{', '.join(COLUMNS)} at most once, "
            "and subject"
        )
    columns: dict[str, list[str]] = {name: [] for name in known}
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        for name, cell in zip(names, [*row, *[""] * len(names)], strict=False):
            if name in columns:
                columns[name].append(known_word(name, cell.strip(), f"{path}: row {number}"))
    return {name: tuple(words) for name, words in columns.items()}


def known_word(column: str, word: str, where: str) -> str:
    """A word of a column in the one spelling that the project uses. Raises HabitusError where it is
    not known.
    """
    word = word if column == "file" else plain_name(word)
    if column == "sex":
        if word.lower() not in _SEXES:
            raise HabitusError(f"{where}: sex is {shown(word)!r}; expected female, male or nothing")
        return _SEXES[word.lower()]
    if column == "set":
        if word and word.lower() not in SETS:
            raise HabitusError(
                f"{where}: set is {shown(word)!r}; expected one of {', '.join(SETS)}, or nothing"
            )
        return word.lower()
    if column == "verdict":
        if word.lower() not in VERDICTS:
            raise HabitusError(
                f"{where}: verdict is {shown(word)!r}; expected {', '.join(VERDICTS[:3])} or "
                "nothing"
            )
        return word.lower()
    if column == "unit":
        if word and unit_of(word) is None:
            raise HabitusError(
                f"{where}: unit is {shown(word)!r}; expected one of {', '.join(METRES)}"
            )
        return unit_of(word) or ""
    if column in ("subject", "file") and not word:
        raise HabitusError(f'{where}: column "{column}" is empty; expected a value in every row')
    return word


def table_text(columns: Mapping[str, Sequence[str]]) -> str:
    """The table as text, for writing."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()
