"""Names out of files in one safe spelling: printable, on one line, of a length that a person would write."""

from habitus.errors import shown
from habitus.io.limits import LONGEST_NAME


def plain_name(text: object) -> str:
    """A label, a subject or another name from a file, as the project spells it: what is blank is a space, what cannot
    be seen is written as an escape (`habitus.errors.shown`), and what is too long is cut in its middle."""
    name = str(text)
    if name.isprintable() and len(name) <= LONGEST_NAME:
        return name.strip()
    if len(name) > 4 * LONGEST_NAME:
        name = name[: 2 * LONGEST_NAME] + name[-2 * LONGEST_NAME :] + "…"
    return shown("".join(" " if letter in "\t\xa0" else letter for letter in name).strip(), LONGEST_NAME)
