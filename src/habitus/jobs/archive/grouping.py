"""Whose captures are one subject's: by a table, else by the file's subject and the folder, and by
what they wore.
"""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from habitus.jobs.archive.table import SubjectsTable
from habitus.jobs.finding import Worn

Key = tuple[str, str]
"""A capture: its file's path below the archive's folder, and who in it ("" where there is one
person).
"""


def grouped_by_subject(
    worn: Iterable[tuple[str, str, Worn]], table: SubjectsTable | None, top: str
) -> dict[Key, str]:
    """The subject of each capture, given in the order of their paths; ``top`` is what the folder of
    all is called.

    A table's subject is one wherever the captures lie; else those of one folder that name one
    subject are. Of either, captures whose markers sit elsewhere are parted, as "ann (2)": one shape
    stage places each marker once. Where what was worn cannot tell, a table is believed, and a
    folder is not.
    """
    heads: dict[str, list[Worn]] = defaultdict(list)
    found: dict[Key, str] = {}
    for path, person, seen in worn:
        told = table.subject(Path(path)) if table is not None and not person else None
        name = told or _folder_name(path, seen.subject, top)
        kin = heads[name]
        number = next(
            (
                k
                for k, head in enumerate(kin)
                if (not head.unlike(seen) if told else head.like(seen))
            ),
            None,
        )
        if number is None:
            number = len(kin)
            kin.append(seen)
        found[path, person] = name if number == 0 else f"{name} ({number + 1})"
    return found


def _folder_name(path: str, subject: str | None, top: str) -> str:
    folder = PurePosixPath(path).parent.as_posix()
    return "/".join(filter(None, ["" if folder == "." else folder, subject or ""])) or top
