"""Named arrays of a model file, whether npz or pickle, read without running anything in them."""

import zipfile
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

import numpy as np

from habitus.errors import HabitusError
from habitus.io.models.pickles import as_array, read_pickle


class ModelArrays:
    """The named arrays of an npz or a pickle, read when asked for and checked for kind, shape and finiteness.

    Every failing raises HabitusError and names the array.
    """

    def __init__(self, file: BinaryIO):
        magic = file.read(2)
        file.seek(0)
        if magic == b"PK":
            try:
                self._zip = zipfile.ZipFile(file)
            except zipfile.BadZipFile as error:
                raise HabitusError(f"this is no whole npz ({error}); get the file anew") from error
            members = {name.removesuffix(".npy"): name for name in self._zip.namelist()}
            self._read: dict[str, Callable[[], np.ndarray]] = {k: self._member(v) for k, v in members.items()}
            return
        content = read_pickle(file)
        if not isinstance(content, Mapping):
            raise HabitusError("the pickle holds no named arrays; expected a body model")
        self._read = {str(k): (lambda value=v: as_array(value)) for k, v in content.items()}

    def _member(self, name: str) -> Callable[[], np.ndarray]:
        def read() -> np.ndarray:
            with self._zip.open(name) as member:
                version = np.lib.format.read_magic(member)
                header = (
                    np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                )
                if header(member)[2].hasobject:
                    return _boxed_array(member)
            with self._zip.open(name) as member:
                return np.lib.format.read_array(member, allow_pickle=False)

        return read

    def __contains__(self, key: str) -> bool:
        return key in self._read

    def __getitem__(self, key: str) -> np.ndarray:
        if key not in self._read:
            have = ", ".join(sorted(self._read)[:12]) or "nothing"
            raise HabitusError(f"no array {key!r} (it has {have}); expected a body model of the SMPL family")
        try:
            return self._read[key]()
        except HabitusError as error:
            raise HabitusError(f"array {key!r}: {error}") from error
        except Exception as error:  # a damaged archive may raise anything
            raise HabitusError(f"array {key!r} cannot be read ({error}); get the file anew") from error

    def number(self, key: str, *shape: int | None, dtype: type = np.float64) -> np.ndarray:
        """An array of finite numbers of a given shape (None: any length)."""
        array = self[key]
        fits = array.ndim == len(shape) and all(
            want in (None, got) for want, got in zip(shape, array.shape, strict=True)
        )
        if array.dtype.kind not in "biuf" or not fits or 0 in array.shape:
            want = ", ".join("*" if n is None else str(n) for n in shape)
            raise HabitusError(
                f"array {key!r} is {array.dtype} of shape {array.shape}; expected numbers of shape ({want})"
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise HabitusError(f"array {key!r} holds numbers that are not finite; get the file anew")
        return np.array(array, dtype=dtype, order="C")

    def index(self, key: str, size: int, *shape: int | None) -> np.ndarray:
        """An integer array with values from 0 to size - 1."""
        array = self.number(key, *shape, dtype=np.int64)
        if array.min() < 0 or array.max() >= size:
            raise HabitusError(f"array {key!r} runs from {array.min()} to {array.max()}; expected 0 to {size - 1}")
        return array

    def text(self, key: str) -> tuple[str, ...]:
        """The words of an array of text."""
        return tuple(str(word) for word in np.atleast_1d(self[key]))


def _boxed_array(member: Any) -> np.ndarray:
    """An array kept as a pickled object inside an npz (a sparse matrix, say)."""
    boxed = read_pickle(member)
    try:
        return as_array(boxed)
    except HabitusError:
        return as_array(boxed.state[4][0])
