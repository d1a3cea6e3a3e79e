"""Arrays of npz archives and npy files, each held against the bytes that are there before memory is
asked for.

Nothing pickled is ever loaded here.
"""

import io
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.io.limits import Allowance, array_size, check_present, open_file
from habitus.parallel.blocks import IN_MEMORY, blocks, drop_pages, empty_array

_VERSIONS = ((1, 0), (2, 0), (3, 0))
_MAX_HEADER = 10_000
_MAX_BRACKETS = 20


@dataclass(frozen=True)
class ArrayHeader:
    """What an npy file says of its array, and at which byte of it the numbers begin."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    begins: int

    @property
    def count(self) -> int:
        """How many numbers it claims to hold."""
        return array_size(self.shape)

    @property
    def weight(self) -> int:
        """The same with empty axes taken for one: rows of nothing, too, take memory once they are a
        list.
        """
        return array_size(tuple(max(n, 1) for n in self.shape))

    @property
    def bytes(self) -> int:
        """How many bytes these take in the file."""
        return self.count * self.dtype.itemsize


def read_header(stream: Any) -> ArrayHeader:
    """The header of an npy file that ``stream`` stands at the beginning of. Raises HabitusError
    where it is none.
    """
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _VERSIONS:
            raise ValueError(f"version {version} of the npy format")
        first = version == (1, 0)
        length = stream.read(2 if first else 4)
        text = stream.read(min(int.from_bytes(length, "little"), _MAX_HEADER))
        if sum(map(text.count, (b"(", b"[", b"{"))) > _MAX_BRACKETS:
            raise ValueError("nested without end")
        read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(io.BytesIO(length + text))
        header = ArrayHeader(tuple(shape), bool(fortran), dtype, 8 + len(length) + len(text))
    except (
        MemoryError
    ):  # how Python's parser says that a text of at most 10,000 bytes is nested too deep
        raise HabitusError("its header is damaged (nested without end)") from None
    except Exception as error:  # numpy evaluates the header as a literal, which may raise anything
        raise HabitusError(f"its header is damaged ({reason(error)})") from error
    array_size(header.shape)
    return header


def checked_texts(array: np.ndarray) -> np.ndarray:
    """The array as it is. Raises HabitusError for texts of numbers that are no characters, which
    would break Python.
    """
    if array.dtype.kind == "U" and array.size and array.dtype.itemsize:
        numbers = (
            np.ascontiguousarray(array)
            .reshape(-1)
            .view(np.dtype("u4").newbyteorder(array.dtype.byteorder))
        )
        if numbers.max() > sys.maxunicode:
            raise HabitusError("its texts hold numbers that are not characters; get the file again")
    return array


def reason(error: BaseException) -> str:
    """What a library says of damage, short and on one line."""
    return shown(str(error).strip() or type(error).__name__, 120)


class NpzArchive:
    """The arrays of an npz. Errors are HabitusErrors that name the array; who reads a file adds the
    file's name.
    """

    def __init__(self, file: BinaryIO | bytes):
        self._file = io.BytesIO(file) if isinstance(file, bytes) else file
        stored = self._file.seek(0, io.SEEK_END)
        self._file.seek(0)
        self._stored = stored
        self.allowance = Allowance(stored)
        try:
            self._zip = zipfile.ZipFile(self._file)
            self._entries = {
                entry.filename.removesuffix(".npy"): entry for entry in self._zip.infolist()
            }
        except Exception as error:  # a damaged archive may raise anything
            raise HabitusError(
                f"not a complete npz ({reason(error)}); save it again with numpy.savez"
            ) from error

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its arrays."""
        return tuple(self._entries)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._entries:
            raise HabitusError(f"no array {shown(name)!r} in it")
        return self.read(name)

    def get(self, name: str) -> np.ndarray | None:
        """An array, or None where there is none of this name."""
        return self.read(name) if name in self._entries else None

    def header(self, name: str) -> ArrayHeader:
        """What the archive says of an array."""
        entry = self._entries[name]
        with _guarded(name), self._zip.open(entry) as stream:
            header = read_header(stream)
            present = min(entry.file_size, self._stored) if _is_stored(entry) else entry.file_size
            check_present(
                header.begins + (0 if header.dtype.hasobject else header.bytes), present, "it"
            )
            return header

    def read(self, name: str) -> np.ndarray:
        """An array of numbers or texts, as long as the archive may hold one of its size."""
        header = self.header(name)
        with _guarded(name):
            if header.dtype.hasobject:
                raise HabitusError(
                    "a pickled object, which could run code; save it as a plain array"
                )
            self.allowance.take(header.weight, header.dtype.itemsize, "it")
            with self._zip.open(self._entries[name]) as stream:
                return checked_texts(_array(stream, header))

    def raw(self, name: str) -> bytes:
        """What follows the header of an array: the pickle of an array of objects."""
        header = self.header(name)
        entry = self._entries[name]
        with _guarded(name):
            self.allowance.take(entry.file_size, 1, "it")
            with self._zip.open(entry) as stream:
                stream.read(header.begins)
                return stream.read(entry.file_size)

    def place(self, name: str) -> int | None:
        """The byte of the file at which an array's numbers begin; None where they are
        compressed.
        """
        header = self.header(name)
        entry = self._entries[name]
        if not _is_stored(entry):
            return None
        with _guarded(name):
            self._file.seek(entry.header_offset + 26)
            lengths = np.frombuffer(self._file.read(4), "<u2").tolist()
            place = entry.header_offset + 30 + sum(lengths) + header.begins
            check_present(place + header.bytes, self._stored, "it")
            return place


def _array(stream: Any, header: ArrayHeader) -> np.ndarray:
    """The array of an npy stream; a large one is file-backed (`habitus.parallel.blocks`) and read a
    block of rows at a time.
    """
    if header.bytes <= IN_MEMORY or header.fortran or header.dtype.kind not in "biuf":
        return np.lib.format.read_array(stream, allow_pickle=False)
    stream.read(header.begins)
    out = empty_array(header.shape, header.dtype)
    row = header.bytes // len(out)
    for part in blocks(len(out), max(1, IN_MEMORY // row)):
        found = np.frombuffer(stream.read((part.stop - part.start) * row), header.dtype)
        out[part] = found.reshape(out[part].shape)
        drop_pages(out)
    return out


def _is_stored(entry: zipfile.ZipInfo) -> bool:
    return entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1


@contextmanager
def _guarded(name: str) -> Iterator[None]:
    """Around the reading of one array: whatever goes wrong is a HabitusError that names it."""
    try:
        yield
    except HabitusError as error:
        raise HabitusError(f"array {shown(name)!r}: {error}") from error
    except Exception as error:  # a damaged archive may raise anything
        raise HabitusError(
            f"array {shown(name)!r} cannot be read ({reason(error)}); save it again"
        ) from error


@contextmanager
def open_archive(path: Path) -> Iterator[NpzArchive]:
    """The archive in a file. Raises OSError where it cannot be opened, HabitusError where it is
    none.
    """
    with open_file(path) as file:
        yield NpzArchive(file)


def read_npy(path: Path) -> np.ndarray:
    """The plain array in an npy file. Raises HabitusError, without the file's name, where it is
    none.
    """
    try:
        with open_file(path) as stream:
            header = mapped_header(stream, path)
            stream.seek(0)
            Allowance(path.stat().st_size).take(header.weight, header.dtype.itemsize, "its array")
            return checked_texts(np.lib.format.read_array(stream, allow_pickle=False))
    except HabitusError:
        raise
    except Exception as error:
        raise HabitusError(
            f"cannot be read ({reason(error)}); save it again with numpy.save"
        ) from error


def mapped_header(stream: BinaryIO, path: Path) -> ArrayHeader:
    """The header of a complete npy file."""
    header = read_header(stream)
    if header.dtype.hasobject:
        raise HabitusError("it is pickled; save plain arrays")
    check_present(header.begins + header.bytes, path.stat().st_size, "its array")
    return header
