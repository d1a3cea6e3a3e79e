"""Named arrays of a model file, whether npz or pickle, read without running anything in them."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, BinaryIO

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.io.archives import NpzArchive
from habitus.io.limits import MAX_NAME_LENGTH, MAX_NAMES, Allowance
from habitus.io.models.pickled_arrays import as_array
from habitus.io.models.pickles import PickledObject, read_pickle


class ModelArrays:
    """The named arrays of an npz or a pickle, read when asked for and checked for kind, shape and
    finiteness.

    ``allowance`` is what the file may fill in all. Every failing raises HabitusError and names the
    array.
    """

    def __init__(self, file: BinaryIO):
        magic = file.read(2)
        file.seek(0)
        if magic == b"PK":
            archive = NpzArchive(file)
            self.allowance = archive.allowance
            self._read: dict[str, Callable[[], np.ndarray]] = {
                name: partial(_from_archive, archive, name) for name in archive.names
            }
            return
        content = file.read()
        self.allowance = Allowance(len(content))
        plain = read_pickle(content)
        if not isinstance(plain, Mapping):
            raise HabitusError("the pickle holds no named arrays; expected a body model")
        self._read = {
            str(k): partial(_from_pickle, str(k), value, self.allowance)
            for k, value in plain.items()
        }

    def changed(self, arrays: Mapping[str, Callable[[], np.ndarray] | None]) -> "ModelArrays":
        """The same file with other arrays in the place of some, made when asked for; without those
        that are None.
        """
        other = object.__new__(ModelArrays)
        other.allowance = self.allowance
        every = {**self._read, **arrays}
        other._read = {key: read for key, read in every.items() if read is not None}
        return other

    def __contains__(self, key: str) -> bool:
        return key in self._read

    def __getitem__(self, key: str) -> np.ndarray:
        if key not in self._read:
            have = ", ".join(shown(name, 40) for name in sorted(self._read)[:12]) or "nothing"
            raise HabitusError(
                f"no array {key!r} (it has {have}); expected a body model of the SMPL family"
            )
        return self._read[key]()

    def number(self, key: str, *shape: int | None, dtype: type = np.float64) -> np.ndarray:
        """An array of finite numbers of a given shape (None: any length)."""
        array = self[key]
        fits = array.ndim == len(shape) and all(
            want in (None, got) for want, got in zip(shape, array.shape, strict=True)
        )
        if array.dtype.kind not in "biuf" or not fits or 0 in array.shape:
            want = ", ".join("*" if n is None else str(n) for n in shape)
            raise HabitusError(
                f"array {key!r} is {array.dtype} of shape {array.shape}; expected numbers of "
                f"shape ({want})"
            )
        with np.errstate(invalid="ignore"):  # NaN as an integer, refused below
            numbers = np.array(array, dtype=dtype, order="C")
        floats = numbers if numbers.dtype.kind == "f" else array  # half precision is slow to check
        if array.dtype.kind == "f" and not np.isfinite(floats).all():
            raise HabitusError(
                f"array {key!r} holds numbers that are not finite; get the file again"
            )
        return numbers

    def index(self, key: str, size: int, *shape: int | None) -> np.ndarray:
        """An integer array with values from 0 to size - 1."""
        array = self.number(key, *shape, dtype=np.int64)
        if array.min() < 0 or array.max() >= size:
            raise HabitusError(
                f"array {key!r} runs from {array.min()} to {array.max()}; expected 0 to {size - 1}"
            )
        return array

    def text(self, key: str) -> tuple[str, ...]:
        """The words of an array of text."""
        words = self[key]
        if words.dtype.kind not in "US" or words.ndim > 1 or words.size > MAX_NAMES:
            raise HabitusError(
                f"array {key!r} is {words.dtype} of shape {words.shape}; expected texts (*)"
            )
        return tuple(shown(_text(word), MAX_NAME_LENGTH) for word in np.atleast_1d(words).tolist())


def _text(word: str | bytes) -> str:
    return word.decode("utf-8", "replace") if isinstance(word, bytes) else word


def _from_archive(archive: NpzArchive, name: str) -> np.ndarray:
    """An array of an npz; one that is kept as a pickled object (a sparse matrix, say) from its
    inert records.
    """
    if not archive.header(name).dtype.hasobject:
        return archive.read(name)
    try:
        boxed = read_pickle(archive.raw(name))
    except HabitusError as error:
        raise HabitusError(f"array {shown(name)!r}: {error}") from error
    return _from_pickle(name, boxed, archive.allowance)


def _from_pickle(name: str, value: Any, allowance: Allowance) -> np.ndarray:
    try:
        return as_array(_unboxed(value), allowance)
    except HabitusError as error:
        raise HabitusError(f"array {shown(name)!r}: {error}") from error


def _unboxed(value: Any) -> Any:
    """What an array of one object holds."""
    state = (
        value.state
        if isinstance(value, PickledObject) and value.name.endswith("._reconstruct")
        else None
    )
    if (
        isinstance(state, tuple)
        and len(state) == 5
        and isinstance(state[4], list)
        and len(state[4]) == 1
    ):
        return state[4][0]
    return value
