"""NumPy arrays and torch tensors under one spelling.

Most of what the body computes reads the same in both libraries: ``xp = namespace(x)``, then
``xp.stack(rows, -1)``. The functions here are for the few things that do not. torch is never
imported: a tensor cannot come without it.
"""

import math
import sys
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np

from habitus.types import Array, ArrayLike


def is_tensor(value: Any) -> bool:
    """Whether it is a torch tensor."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def namespace(*arrays: Any) -> Any:
    """The library that computes with these: torch if any is a tensor, otherwise NumPy."""
    torch = sys.modules.get("torch")
    return (
        torch
        if torch is not None and any(isinstance(array, torch.Tensor) for array in arrays)
        else np
    )


def to_numpy(array: ArrayLike, dtype: Any = None) -> np.ndarray:
    """A tensor (on any device, dense or sparse, with or without gradient) or array-like as a
    C-ordered NumPy array.

    It may share memory with what was given.
    """
    if is_tensor(array):
        array = array.detach().cpu()
        array = (array.to_dense() if array.is_sparse else array).numpy()
    return np.asarray(array, dtype=dtype, order="C")


class Kind(NamedTuple):
    """What arrays are: their library (numpy or torch), floating dtype and device (None for
    NumPy).
    """

    xp: Any
    dtype: Any
    device: Any = None

    def array(self, values: ArrayLike) -> Array:
        """Numbers as an array of this kind: the same object where it is one already."""
        if self.xp is np:
            return np.asarray(values, self.dtype)
        if isinstance(values, self.xp.Tensor):
            return values.to(self.device, self.dtype)
        return self.xp.as_tensor(values, dtype=self.dtype, device=self.device)

    def index(self, values: np.ndarray) -> Array:
        """Whole numbers, int64, in this library and on this device."""
        return values if self.xp is np else self.xp.as_tensor(values, device=self.device)

    def zeros(self, *shape: int) -> Array:
        """Zeros."""
        return (
            np.zeros(shape, self.dtype)
            if self.xp is np
            else self.xp.zeros(shape, dtype=self.dtype, device=self.device)
        )

    @property
    def compiled(self) -> type[np.floating]:
        """The dtype that compiled code reckons in for these."""
        return np.float64 if self.dtype.itemsize == 8 else np.float32

    def lasting(self) -> AbstractContextManager:
        """Within it arrays are made that may be kept: no inference tensors of torch."""
        return nullcontext() if self.xp is np else self.xp.inference_mode(False)


def kind_of(*values: Any) -> Kind:
    """The kind in which these are computed together; None and plain Python numbers and sequences
    have no say.

    Tensors decide where there is one: the widest of their floating dtypes, the device of the first.
    Otherwise it is NumPy's float32 where all arrays are float32 (or float16), and float64 else.
    """
    torch = sys.modules.get("torch")
    tensors = (
        [] if torch is None else [value for value in values if isinstance(value, torch.Tensor)]
    )
    if torch is None or not tensors:
        dtypes = {value.dtype for value in values if isinstance(value, (np.ndarray, np.generic))}
        small = bool(dtypes) and dtypes <= {np.dtype(np.float16), np.dtype(np.float32)}
        return Kind(np, np.dtype(np.float32 if small else np.float64))
    dtypes = {tensor.dtype for tensor in tensors if tensor.is_floating_point()} or {
        torch.get_default_dtype()
    }
    dtype = dtypes.pop()
    for other in dtypes:
        dtype = torch.promote_types(dtype, other)
    return Kind(torch, dtype, tensors[0].device)


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """The runs of True in flags (T,), each as (first, last + 1)."""
    edges = np.flatnonzero(np.diff(np.asarray(flags, np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def broadcast_shapes(*shapes: Iterable[int]) -> tuple[int, ...]:
    """The shape that all broadcast to; ValueError where they do not.

    torch's own function of this name loads a system of computer algebra when first called, which
    takes half a second.
    """
    return np.broadcast_shapes(*(tuple(shape) for shape in shapes))


def constant(values: Any, like: Array) -> Array:
    """Numbers as an array of the library, dtype and device of ``like``."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(like, torch.Tensor):
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    return np.asarray(values, like.dtype)


def eye(n: int, like: Array) -> Array:
    """The unit matrix in the library, dtype and device of ``like``."""
    return namespace(like).eye(n, dtype=like.dtype, device=like.device)


def cast(values: Array, like: Array) -> Array:
    """An array in the dtype of ``like``, a truth value as 0 or 1."""
    return values.to(like.dtype) if is_tensor(values) else np.asarray(values, like.dtype)


def unbind(array: Array, axis: int = -1) -> Sequence[Array]:
    """The slices along an axis."""
    return array.unbind(axis) if is_tensor(array) else tuple(np.moveaxis(array, axis, 0))


def flatten(array: Array, first: int, last: int = -1) -> Array:
    """Axes ``first`` to ``last`` as one; empty arrays included."""
    if is_tensor(array):
        return array.flatten(first, last)
    first = first % array.ndim
    last = last % array.ndim
    shape = array.shape
    return array.reshape(*shape[:first], math.prod(shape[first : last + 1]), *shape[last + 1 :])


def unflatten(array: Array, axis: int, shape: Sequence[int]) -> Array:
    """One axis as several; one of ``shape`` may be -1."""
    if is_tensor(array):
        return array.unflatten(axis, tuple(shape))
    axis = axis % array.ndim
    known = math.prod(n for n in shape if n >= 0)
    whole = [array.shape[axis] // max(known, 1) if n < 0 else n for n in shape]
    return array.reshape(*array.shape[:axis], *whole, *array.shape[axis + 1 :])


def take(array: Array, index: Array, axis: int) -> Array:
    """The slices of an axis with these numbers."""
    return array.index_select(axis, index) if is_tensor(array) else np.take(array, index, axis)


def take_along(array: Array, index: Array, axis: int) -> Array:
    """The elements of an axis that ``index`` names at each place; the other axes are equally long
    in both.
    """
    return array.gather(axis, index) if is_tensor(array) else np.take_along_axis(array, index, axis)


def add_slices(array: Array, index: Sequence[int], values: Array, axis: int) -> Array:
    """The array with ``values`` added to the slices of an axis with these different numbers."""
    if is_tensor(array):
        where = namespace(array).as_tensor(index, device=array.device)
        return array.index_add(axis, where, values)
    total = np.moveaxis(array.copy(order="K"), axis, 0)
    total[list(index)] += np.moveaxis(values, axis, 0)
    return np.moveaxis(total, 0, axis)


def cross(a: Array, b: Array, axis: int = -1) -> Array:
    """The cross product along an axis of length 3; the other axes broadcast."""
    if is_tensor(a) or is_tensor(b):
        return namespace(a).linalg.cross(a, b, axis=axis)
    # numpy's own moves axes about, which for a few vectors takes longer than the products
    (ax, ay, az), (bx, by, bz) = unbind(a, axis), unbind(b, axis)
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis)


def multiply_add(total: Array, a: Array, b: Array) -> Array:
    """``total + a * b``, in one pass where the library can."""
    return total.addcmul(a, b) if is_tensor(total) else total + a * b


def first_not_finite(array: np.ndarray, rows: int = 1 << 16) -> int | None:
    """The first row of an array that holds NaN or an infinity, None where there is none; looked for
    ``rows`` at a time, as long arrays may lie over files.
    """
    for start in range(0, len(array), rows):
        part = np.isfinite(array[start : start + rows])
        if not part.all():
            known = part.reshape(len(part), -1).all(axis=1)
            return start + int(np.argmin(known))
    return None
