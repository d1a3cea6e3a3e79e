"""Names out of files, made safe as names of files."""

import hashlib
import os
import re
from pathlib import Path

from habitus.errors import HabitusError, shown

_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_APART = re.compile(r'[<>:"/\\|?*]')
_LONGEST = 180  # bytes; with what is put before and after it, 255 are never reached
_ANY = 1 << 30


def shown_stem(path: Path) -> str:
    """A file's name without its ending, as a text that can be shown and encoded: what is no text becomes an escape."""
    return shown(os.fsencode(path.stem).decode("utf-8", "backslashreplace"), _ANY)


def file_name(text: str, where: str = "") -> str:
    """A text as the name of one file or folder: it names nothing elsewhere, nothing hidden and no device.

    Separators become ``_``; what cannot be seen or encoded is written as an escape, ``_x1b``; what is longer than file
    systems take is cut, and told apart by a digest of the whole. ``where`` is what the error names. Raises HabitusError
    for an empty text, ``.`` and ``..``.
    """
    if text.strip() in ("", ".", ".."):
        raise HabitusError(
            f"{where or shown(text) or 'a name'}: its results cannot be called {text!r}; rename the file"
        )
    name = re.sub(r"^[. ]|[. ]$", "_", _APART.sub("_", shown(text, _ANY)))
    if _RESERVED.fullmatch(name):
        name = f"_{name}"
    if len(name.encode()) > _LONGEST:
        digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:8]
        name = f"{name.encode()[:_LONGEST].decode(errors='ignore')}~{digest}"
    return name
