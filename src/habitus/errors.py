"""The one family of errors that a user is meant to read."""

from collections.abc import Iterable
from types import ModuleType

LONGEST_MESSAGE = 499


class HabitusError(Exception):
    """Bad input, said in one line: what arrived, what was expected, what to do. The command exits
    with 2.

    Whatever the message quotes, it is one line of fewer than 500 characters that a terminal shows
    as they are.
    """

    def __init__(self, message: object = ""):
        lines = (line.strip() for line in str(message).splitlines())
        super().__init__(shown(" ".join(filter(None, lines)), LONGEST_MESSAGE))


def shown(text: object, limit: int = 80) -> str:
    """A name out of a file, safe to show on one line: in a message, a terminal or a page.

    Control characters, marks that turn the direction of writing, halves of characters and whatever
    else cannot be seen are written as ``\\x1b`` or ``\\u202e``; what is longer than ``limit``
    characters (at least 3) is cut in its middle.
    """
    raw = str(text)
    if len(raw) > 2 * limit:  # far too long: only the ends will be seen
        raw = raw[:limit] + raw[-limit:]
    safe = raw if raw.isprintable() else "".join(map(_visible, raw))
    if len(safe) <= limit and len(raw) == len(str(text)):
        return safe
    tail = (limit - 1) // 3
    return f"{safe[: limit - 1 - tail]}…{safe[len(safe) - tail :]}"


def listed(names: Iterable[str], most: int = 8, between: str = ", ") -> str:
    """The first of some names, and how many more there are: what a person reads to the end."""
    names = list(names)
    more = f" … and {len(names) - most} more" if len(names) > most else ""
    return between.join(names[:most]) + more


def _visible(character: str) -> str:
    if character.isprintable():
        return character
    code = ord(character)
    return (
        f"\\x{code:02x}"
        if code < 0x100
        else f"\\u{code:04x}"
        if code < 0x10000
        else f"\\U{code:08x}"
    )


def require_extra(module: str, what: str, extra: str = "train") -> ModuleType:
    """A module that comes with an extra. Raises HabitusError, saying how to get it, where it is not
    installed.
    """
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise _missing(module, what, extra) from error


def check_extra(module: str, what: str, extra: str = "train") -> None:
    """The same, where the module is there but is not wanted yet: it is not imported."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise _missing(module, what, extra)


def _missing(module: str, what: str, extra: str) -> HabitusError:
    return HabitusError(
        f"{what} need {module}, which is not installed; install it with: pip install "
        f"'habitus[{extra}]'"
    )


class TorchIsAnExtra:
    """Around a block that may need PyTorch: a HabitusError says how to get it where it is not
    installed.
    """

    def __init__(self, what: str):
        self.what = what

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if isinstance(error, ModuleNotFoundError) and error.name == "torch":
            raise HabitusError(
                f"{self.what} needs PyTorch, which is not installed; install it with: pip install "
                "'habitus[torch]' "
                "(or habitus[train], habitus[images])"
            ) from error
