"""Arrays of a million frames in bounded memory: where they are stored, and how to process them in
blocks of frames.

Arrays up to `IN_MEMORY` bytes are plain NumPy arrays and are processed at once. Larger ones are
NumPy arrays over a file that has no name, vanishes with them, and is read and written by the
operating system as they are used: in the folder that TMPDIR names, else /var/tmp, else where
temporary files go.
"""

import mmap
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from habitus.errors import HabitusError

IN_MEMORY = 1 << 26
"""Bytes up to which an array is kept in memory."""
BLOCK = 8192
"""Frames that are worked on together."""


def empty_array(shape: Sequence[int], dtype: Any = np.float64) -> np.ndarray:
    """An uninitialised array: in memory, or backed by a nameless file where it is large.

    Raises HabitusError where the disk has not enough space.
    """
    size = int(np.prod(shape, dtype=object)) * np.dtype(dtype).itemsize
    if size <= IN_MEMORY:
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile(dir=_folder()) as file:
        try:
            _reserve(file.fileno(), size)
        except OSError as error:
            raise HabitusError(
                f"a long capture needs {size / 1e9:.1f} GB more of temporary files in {_folder()} "
                f"({error.strerror or error}); free some room or set TMPDIR to another folder"
            ) from None
        return np.ndarray(tuple(shape), dtype, buffer=mmap.mmap(file.fileno(), size))


def _reserve(file: int, size: int) -> None:
    """Allocate the disk space now: a disk that is full when a mapped page is written would end the
    process.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def _folder() -> str:
    """/tmp is memory on some machines, /var/tmp is not."""
    lasting = Path("/var/tmp")
    if "TMPDIR" not in os.environ and lasting.is_dir() and os.access(lasting, os.W_OK):
        return str(lasting)
    return tempfile.gettempdir()


def blocks(frames: int, size: int | None = None) -> Iterator[slice]:
    """The frames from the first to the last, `BLOCK` or so many at a time."""
    size = size or BLOCK
    for first in range(0, frames, size):
        yield slice(first, min(first + size, frames))


def drop_pages(*arrays: np.ndarray | None) -> None:
    """Drop the resident pages of file-backed arrays from memory; their values stay in the file."""
    for array in arrays:
        file = _mapping(array)
        if file is not None and hasattr(mmap, "MADV_DONTNEED"):
            file.madvise(mmap.MADV_DONTNEED)


def is_file_backed(array: np.ndarray) -> bool:
    """Whether it is one of the large arrays of `empty_array`, or a part of one."""
    return _mapping(array) is not None


def _mapping(array: Any) -> mmap.mmap | None:
    while isinstance(array, np.ndarray):
        array = array.base
    return array if isinstance(array, mmap.mmap) else None


def is_large(*arrays: np.ndarray) -> bool:
    """Whether one of these takes more than `IN_MEMORY`."""
    return any(array.nbytes > IN_MEMORY for array in arrays)


def mapped(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """``function(*arrays)`` where each frame (first axis) of the result depends on that frame of
    the arrays alone.

    Long arrays are processed in blocks, and the result may be file-backed.
    """
    frames = len(arrays[0])
    if frames <= BLOCK:
        return function(*arrays)
    out = None
    for part in blocks(frames):
        result = function(*(array[part] for array in arrays))
        if out is None:
            out = empty_array((frames, *result.shape[1:]), result.dtype)
        out[part] = result
        drop_pages(out, *arrays)
    assert out is not None
    return out


def distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(T, M) distances between points (T, M, 3), NaN where one is missing."""
    return mapped(lambda a, b: np.linalg.norm(a - b, axis=2), first, second)


def joined(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """``np.concatenate(arrays)``; a single array as it is."""
    if len(arrays) == 1:
        return arrays[0]
    out = empty_array((sum(map(len, arrays)), *arrays[0].shape[1:]), arrays[0].dtype)
    first = 0
    for array in arrays:
        for part in blocks(len(array)):
            out[first + part.start : first + part.stop] = array[part]
            drop_pages(out, array)
        first += len(array)
    return out


def take_frames(array: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """``array[frames]`` for increasing frames, which may be far apart."""
    if not is_large(array):
        return array[frames]
    out = empty_array((len(frames), *array.shape[1:]), array.dtype)
    for part in blocks(len(frames), BLOCK // 16):
        out[part] = array[frames[part]]
        drop_pages(out, array)
    return out


def every_nth_frame(array: np.ndarray, stride: int) -> np.ndarray:
    """``array[::stride]``."""
    return (
        take_frames(array, np.arange(0, len(array), stride)) if is_large(array) else array[::stride]
    )


def by_column(function: Callable[[np.ndarray], np.ndarray], array: np.ndarray) -> np.ndarray:
    """``function`` of each column (T, …) of an array (T, M, …) by itself, stacked (M, …): one
    column fits in memory.
    """
    return np.stack([function(column) for column in columns(array)])


def columns(array: np.ndarray, together: int = 4) -> Iterator[np.ndarray]:
    """Each column (T, …) of an array (T, M, …), contiguous; of large arrays a few are read
    together.
    """
    step = together if is_large(array) else array.shape[1]
    for first in range(0, array.shape[1], max(step, 1)):
        yield from _read_columns(array, range(first, min(first + step, array.shape[1])))


def with_columns(
    array: np.ndarray,
    chosen: Sequence[int],
    function: Callable[[np.ndarray, int], np.ndarray],
    together: int = 4,
) -> np.ndarray:
    """A copy of an array (T, M, …) with ``function(column, k)`` in place of each of the columns
    ``chosen``.
    """
    out = mapped(np.array, array)
    if not is_large(array):
        for k in chosen:
            out[:, k] = function(array[:, k], k)
        return out
    for first in range(0, len(chosen), together):
        some = chosen[first : first + together]
        changed = [
            function(column, k) for column, k in zip(_read_columns(array, some), some, strict=True)
        ]
        for part in blocks(len(array)):
            for k, column in zip(some, changed, strict=True):
                out[part, k] = column[part]
            drop_pages(out)
    return out


def _read_columns(array: np.ndarray, chosen: Sequence[int]) -> list[np.ndarray]:
    columns = [np.empty((len(array), *array.shape[2:]), array.dtype) for _ in chosen]
    for part in blocks(len(array)):
        for k, column in zip(chosen, columns, strict=True):
            column[part] = array[part, k]
        drop_pages(array)
    return columns
