"""Files as on Windows, on Linux: what is open or mapped is neither renamed, replaced nor removed,
nor is a folder around it, and nothing is renamed onto what is there.
"""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

SUPPORTED = Path("/proc/self/maps").exists()
"""Whether this system says which files are open."""


def open_files() -> set[str]:
    """Paths of the files that this process has open or mapped."""
    found = set()
    for handle in Path("/proc/self/fd").iterdir():
        try:
            found.add(os.readlink(handle))
        except OSError:  # closed meanwhile
            continue
    for line in Path("/proc/self/maps").read_text().splitlines():
        found |= set(line.split(maxsplit=5)[5:])
    return {path for path in found if path.startswith("/") and not os.path.isdir(path)}


@contextmanager
def as_on_windows() -> Iterator[None]:
    """Let `os` refuse what Windows does; `pathlib`, `shutil` and `tempfile` call it."""
    # filelock has code of its own there, which takes care of its file
    real = {name: getattr(os, name) for name in ("rename", "replace", "unlink", "remove", "rmdir")}

    def guarded(name: str) -> Callable[..., None]:
        def call(*paths: os.PathLike[str], **more: int) -> None:
            caller = sys._getframe(1).f_globals.get("__name__", "")
            if not more and not caller.startswith("filelock"):
                _refuse_open(paths)
                if len(paths) == 2:
                    _refuse_taken(*paths, name == "replace")
            real[name](*paths, **more)

        return call

    with patch.multiple(os, **{name: guarded(name) for name in real}):
        yield


def _refuse_open(paths: tuple[os.PathLike[str], ...]) -> None:
    for path in paths:
        full = os.path.realpath(path)
        if any(name == full or name.startswith(f"{full}/") for name in open_files()):
            raise PermissionError(errno.EACCES, "it is used by another process", str(path))


def _refuse_taken(source: os.PathLike[str], target: os.PathLike[str], replaces: bool) -> None:
    if not os.path.lexists(target) or os.path.realpath(source) == os.path.realpath(target):
        return
    if not replaces:
        raise FileExistsError(errno.EEXIST, "it is there already", str(target))
    if os.path.isdir(target):
        raise PermissionError(errno.EACCES, "a folder is not replaced", str(target))
