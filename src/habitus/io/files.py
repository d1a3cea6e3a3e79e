"""Files are written whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from habitus.errors import HabitusError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file beside ``path`` that takes its place when the block ends well, and vanishes otherwise.

    Raises HabitusError where the folder cannot be made or written to.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.stem[:40]}-", suffix=target.suffix)
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
        os.replace(temporary, target)
    except OSError as error:
        raise HabitusError(
            f"cannot write {target}: {error.strerror or error}; free some room or choose another folder"
        ) from error
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def writable_folder(folder: Path) -> Path:
    """The folder, made if need be. Raises HabitusError where it cannot be made or written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HabitusError(f"cannot write to {folder}: {error.strerror}; choose another folder with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise HabitusError(f"cannot write to {folder}: permission denied; choose another folder with --out")
    return folder


@contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Lock the folder (created if missing) until the block ends or the process dies.

    Raises HabitusError where another process holds it, or it cannot be written to.
    """
    lock = FileLock(writable_folder(folder) / "lock")
    try:
        lock.acquire(timeout=0)
    except OSError as error:
        if isinstance(error, Timeout):
            raise HabitusError(
                f"{folder}: another run is at work in it; wait for its end or choose another folder with --out"
            ) from error
        raise HabitusError(
            f"{lock.lock_file}: cannot be locked ({error.strerror or error}); choose another folder with --out"
        ) from error
    try:
        yield
    finally:
        lock.release()
