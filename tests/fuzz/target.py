"""What is spoilt and who reads it: a target has sound trees of files and a reader.

A seed is a small tree of files (relative path -> bytes); the reader is given one of them. `read`
gives nothing back: it passes where the reader gave sane values, and lets everything else out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

Tree = Mapping[str, bytes]


@dataclass(frozen=True)
class Target:
    """A reader: its sound trees, the file or folder that is read, and its share of the mutants
    (slow ones get less).
    """

    name: str
    trees: tuple[Tree, ...]
    entry: str
    read: Callable[[Path], None]
    share: int = 4


def tree_of(folder: Path) -> Tree:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def alone(name: str, read: Callable[[Path], None], *contents: bytes) -> Target:
    return Target(name, tuple({name: content} for content in contents), name, read)
