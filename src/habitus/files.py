"""Files and folders are written whole or not at all, under names that are safe; one lock keeps runs
apart.

What is being written stands under a hidden name beside its place, ``.NAME.partial-…``, and takes
the place in one step. An older folder is first moved to ``.NAME.old-…``; files that belong together
are first collected in ``.files.ready-…``. `tidy` removes what killed runs left, puts an older
folder back where a run was killed between the two steps, and places files that were ready.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from habitus.errors import HabitusError

LOCK = ".lock"
_LEFT = re.compile(r"\.(?P<name>.+)\.(?P<kind>partial|old|ready)-[a-z0-9_]{8}(\.[^.]*)?", re.DOTALL)
_ROOM = "free some room or choose another folder"


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file beside ``path`` that takes its place when the block ends well, and vanishes
    otherwise.

    It is on the disk before it takes the place. Raises HabitusError where the folder cannot be made
    or written to.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        prefix = f".{target.stem[:40]}.partial-"
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=prefix, suffix=target.suffix)
    except OSError as error:
        raise HabitusError(
            f"cannot write {target}: {error.strerror or error}; "
            "expected a folder that may be written to; choose another one"
        ) from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        _flush(temporary)
        os.replace(temporary, target)
    except OSError as error:
        raise HabitusError(f"cannot write {target}: {error.strerror or error}; {_ROOM}") from error
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text as UTF-8, whole or not at all; what UTF-8 cannot hold is written as an
    escape.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


@contextmanager
def whole_folder(path: str | os.PathLike[str], ours: Collection[str] = ()) -> Iterator[Path]:
    """A hidden folder beside ``path`` that takes its place when the block ends well, and vanishes
    otherwise.

    An older folder is replaced as a whole; what it holds beside ``ours``, the names that earlier
    runs may have written, is not the program's and moves into the new one. Raises HabitusError
    where that cannot be done.
    """
    target = replaceable(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}.partial-"))
    except OSError as error:
        raise HabitusError(
            f"cannot write {target}: {error.strerror or error}; choose another folder"
        ) from error
    try:
        yield partial
        partial.chmod(0o777 & ~_umask())
        for folder in (*(inner for inner in partial.rglob("*") if inner.is_dir()), partial):
            _flush(folder)
        _take_place(partial, target, ours)
    except HabitusError as error:
        raise HabitusError(str(error).replace(str(partial), str(target))) from error
    except OSError as error:
        raise HabitusError(f"cannot write {target}: {error.strerror or error}; {_ROOM}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def files_together(folder: Path, ours: Collection[str] = ()) -> Iterator[Path]:
    """A hidden folder in ``folder`` whose files take their places there when the block ends well,
    and vanish otherwise; of ``ours``, those that it lacks are removed.

    It is renamed to ``.files.ready-…`` first: where a kill comes between the files, `tidy` places
    the others. Raises HabitusError where that cannot be done.
    """
    try:
        for left in folder.glob(".files.ready-*"):
            _place(left, folder)
        partial = Path(tempfile.mkdtemp(dir=folder, prefix=".files.partial-"))
    except OSError as error:
        raise HabitusError(
            f"cannot write to {folder}: {error.strerror or error}; choose another folder"
        ) from error
    try:
        yield partial
        for name in ours:
            (partial / name).touch()
        _flush(partial)
        ready = partial.with_name(partial.name.replace(".partial-", ".ready-"))
        os.rename(partial, ready)
        _flush(folder)
        _place(ready, folder)
    except HabitusError as error:
        raise HabitusError(str(error).replace(str(partial), str(folder))) from error
    except OSError as error:
        raise HabitusError(f"cannot write {folder}: {error.strerror or error}; {_ROOM}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _place(ready: Path, folder: Path) -> None:
    """Move a folder's files to ``folder``; an empty one stands for a file to remove."""
    for path in ready.iterdir():
        if path.stat().st_size:
            os.replace(path, folder / path.name)
        else:
            (folder / path.name).unlink(missing_ok=True)
            path.unlink()
    _flush(folder)
    ready.rmdir()


def replaceable(path: str | os.PathLike[str]) -> Path:
    """The absolute path of a folder that may be replaced. Raises HabitusError for a file and for
    the working folder.
    """
    target = Path(os.path.abspath(path))
    if target.exists() and not target.is_dir():
        raise HabitusError(
            f"cannot write the folder {path}: a file of this name is there; move it away"
        )
    with suppress(FileNotFoundError):  # of a working folder that is gone
        if Path.cwd().is_relative_to(os.path.realpath(target)):
            raise HabitusError(
                f"cannot replace {path}: it is the working folder; start the program from another "
                "one"
            )
    return target


def _take_place(partial: Path, target: Path, ours: Collection[str]) -> None:
    """Move the older folder aside and the new one to its place; each step can be the last."""
    aside = partial.with_name(f".{target.name}.old-{partial.name[-8:]}")
    older = os.path.lexists(target)
    try:
        if older:
            os.rename(target, aside)
        os.rename(partial, target)
    except BaseException:
        if older and not os.path.lexists(target):
            os.rename(aside, target)
        raise
    _flush(target.parent)
    if older:
        _clear(aside, target, ours)


def _clear(aside: Path, target: Path, ours: Collection[str]) -> None:
    """Remove an older folder; what is not the program's moves on to the new one."""
    if aside.is_symlink() or not aside.is_dir():
        aside.unlink()
        return
    for entry in aside.iterdir():
        stale = (
            entry.name in ours
            or _LEFT.fullmatch(entry.name)
            or os.path.lexists(target / entry.name)
        )
        if not stale:
            os.rename(entry, target / entry.name)
    shutil.rmtree(aside, ignore_errors=True)


def tidy(folder: Path, ours: Collection[str] = (), name: str | None = None) -> None:
    """Remove what killed runs left in a folder that nobody else is at work in; ``ours`` as for
    `whole_folder`. With a ``name``, only what they left of the folder of this name.
    """
    readable = folder.is_dir() and os.access(folder, os.R_OK)
    entries = list(folder.iterdir()) if readable else []
    for entry in entries:
        temporary = _LEFT.fullmatch(entry.name)
        if temporary is None or (name and not (temporary["name"] == name and entry.is_dir())):
            continue
        with suppress(OSError):
            if temporary["kind"] == "old" and not os.path.lexists(folder / temporary["name"]):
                os.rename(entry, folder / temporary["name"])
            elif temporary["kind"] == "ready":
                _place(entry, folder)
            elif temporary["kind"] == "old":
                _clear(entry, folder / temporary["name"], ours)
            elif entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink()


def _flush(path: Path) -> None:
    """See to it that a file, or a folder's list of names, is on the disk; where folders cannot be
    asked, nothing.
    """
    folder = path.is_dir()
    try:
        handle = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
    except OSError:
        if folder:
            return
        raise
    try:
        os.fsync(handle)
    except OSError:
        if not folder:
            raise
    finally:
        os.close(handle)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def writable_folder(folder: Path) -> Path:
    """The folder, made if need be. Raises HabitusError where it cannot be made or written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HabitusError(
            f"cannot write to {folder}: {error.strerror}; choose another folder with --out"
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise HabitusError(
            f"cannot write to {folder}: permission denied; choose another folder with --out"
        )
    return folder


@contextmanager
def locked(folder: Path, ours: Collection[str] = ()) -> Iterator[None]:
    """Keep other runs out of the folder (created if missing) until the block ends or the process
    dies; `tidy` it first, and what is left beside it of runs that replaced it as a whole.

    Raises HabitusError at once where another run is at work in it, or it cannot be written to.
    """
    target = Path(os.path.abspath(folder))
    if not os.path.lexists(target):
        tidy(target.parent, ours, target.name)  # a kill between two renames: the older one returns
    is_new = not folder.exists()
    lock = FileLock(writable_folder(folder) / LOCK, mode=0o666 & ~_umask())
    try:
        lock.acquire(timeout=0)
    except OSError as error:
        if isinstance(error, Timeout):
            raise HabitusError(
                f"{folder}: another run is at work in it; wait for its end or choose another "
                "folder with --out"
            ) from error
        raise HabitusError(
            f"{lock.lock_file}: cannot be locked ({error.strerror or error}); choose another "
            "folder with --out"
        ) from error
    try:
        tidy(folder, ours)
        tidy(target.parent, ours, target.name)
        yield
    finally:
        removed = _removed(lock.lock_file)  # who waits for it sees that it has no name any more
        lock.release()
        if not removed:  # Windows removes no open file
            _removed(lock.lock_file)
        if is_new:
            with suppress(OSError):  # it holds results
                folder.rmdir()


def _removed(path: str) -> bool:
    """Whether there is no such file any more."""
    try:
        os.unlink(path)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return True
