"""Names out of files, made safe: to be shown on one line, and as names of files."""

import hashlib
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_NAME_LENGTH

_RESERVED = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[\d¹²³]) *(\..*)?", re.IGNORECASE
)
_APART = re.compile(r'[<>:"/\\|?*]')
_MAX_LENGTH = 180  # bytes; with what is put before and after it, 255 are never reached
_ANY = 1 << 30


def inside(path: str) -> Path:
    """A path out of a file, which may only lead further down from where that file lies.

    Raises HabitusError for one that is absolute, leads up or is empty.
    """
    way = PurePath(path)
    if not path.strip() or "\0" in path or way.anchor or ".." in way.parts:  # C:x has an anchor
        raise HabitusError(
            f"{shown(path)!r} leads out of the folder that names it; expected a file beside it or "
            "below"
        )
    return Path(path)


def numeric_order(name: str) -> list[tuple[bool, int, str]]:
    """A key that sorts names by the numbers in them: scan2 before scan10."""
    return [
        (
            word.isascii() and word.isdigit(),
            int(word) if word.isascii() and word.isdigit() else 0,
            word,
        )
        for word in re.split(r"([0-9]+)", name)
    ]


def plain_name(text: object) -> str:
    """A label, a subject or another name from a file, as the project spells it: what is blank is a
    space, what cannot be seen is written as an escape (`habitus.errors.shown`), and what is too
    long is cut in its middle.
    """
    name = str(text)
    if name.isprintable() and len(name) <= MAX_NAME_LENGTH:
        return name.strip()
    if len(name) > 4 * MAX_NAME_LENGTH:
        name = name[: 2 * MAX_NAME_LENGTH] + name[-2 * MAX_NAME_LENGTH :] + "…"
    return shown(
        "".join(" " if letter in "\t\xa0" else letter for letter in name).strip(), MAX_NAME_LENGTH
    )


def shown_stem(path: Path) -> str:
    """A file's name without its ending, as a text that can be shown and encoded: what is no text
    becomes an escape.
    """
    return shown(escaped(path.stem), _ANY)


def escaped(name: str) -> str:
    """A file's name, with escapes for bytes that are not UTF-8."""
    try:
        encoded = os.fsencode(name)
    except UnicodeEncodeError:  # the locale's encoding lacks a character
        encoded = name.encode("utf-8", "surrogatepass")
    return encoded.decode("utf-8", "backslashreplace")


def file_name(text: str, where: str = "") -> str:
    """A text as the name of one file or folder: it names nothing elsewhere, nothing hidden and no
    device.

    Separators become ``_``; what cannot be seen or encoded is written as an escape, ``_x1b``; what
    is longer than file systems take is cut, and told apart by a digest of the whole. ``where`` is
    what the error names. Raises HabitusError for an empty text, ``.`` and ``..``.
    """
    if text.strip() in ("", ".", ".."):
        raise HabitusError(
            f"{where or shown(text) or 'a name'}: its results cannot be called {text!r}; rename "
            "the file"
        )
    name = re.sub(r"^[. ]|[. ]$", "_", _APART.sub("_", shown(text, _ANY)))
    if _RESERVED.fullmatch(name):
        name = f"_{name}"
    if len(name.encode()) > _MAX_LENGTH:
        digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:8]
        name = f"{name.encode()[:_MAX_LENGTH].decode(errors='ignore')}~{digest}"
    return name


def name_key(folder: Path) -> Callable[[str], str]:
    """A key that is equal for names of the same file in a folder: most disks of Windows and macOS
    ignore case and how letters are composed. The folder need not exist.
    """
    named = (
        place
        for place in (folder.absolute(), *folder.absolute().parents)
        if place.name.swapcase() != place.name and os.path.exists(place)
    )
    there = next(named, None)
    if there is None or not os.path.exists(there.with_name(there.name.swapcase())):
        return str
    return lambda name: unicodedata.normalize("NFC", name).casefold()


def one_file(names: Sequence[str], folder: Path) -> list[str]:
    """Those of the names that would be the same file in a folder as another one."""
    key = name_key(folder)
    counts = Counter(map(key, names))
    return sorted({name for name in names if counts[key(name)] > 1})
