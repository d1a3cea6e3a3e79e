"""Names out of files in one safe spelling: printable, on one line, of a length that a person would write."""

from pathlib import Path, PurePath

from habitus.errors import HabitusError, shown
from habitus.io.limits import LONGEST_NAME


def inside(path: str) -> Path:
    """A path out of a file, which may only lead further down from where that file lies.

    Raises HabitusError for one that is absolute, leads up or is empty.
    """
    way = PurePath(path)
    if not path.strip() or "\0" in path or way.is_absolute() or ".." in way.parts:
        raise HabitusError(f"{shown(path)!r} leads out of the folder that names it; expected a file beside it or below")
    return Path(path)


def plain_name(text: object) -> str:
    """A label, a subject or another name from a file, as the project spells it: what is blank is a space, what cannot
    be seen is written as an escape (`habitus.errors.shown`), and what is too long is cut in its middle."""
    name = str(text)
    if name.isprintable() and len(name) <= LONGEST_NAME:
        return name.strip()
    if len(name) > 4 * LONGEST_NAME:
        name = name[: 2 * LONGEST_NAME] + name[-2 * LONGEST_NAME :] + "…"
    return shown("".join(" " if letter in "\t\xa0" else letter for letter in name).strip(), LONGEST_NAME)
