"""The arrays that the inert records of a pickle stand for."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_PICKLE_STEPS, Allowance, array_size
from habitus.io.models.pickles import PickledObject

_NUMBER = re.compile(r"[<>=|]?([biuf][1248]|\?)")
_DEEPEST = 32


def as_array(value: Any, allowance: Allowance | None = None) -> np.ndarray:
    """The array that an entry of a pickle stands for; sparse matrices become dense.

    Raises HabitusError where the entry is no array of numbers and no text, or would fill more than
    the file's ``allowance`` (by default that of a small file).
    """
    allowance = allowance or Allowance(0)
    try:
        array = _array(value, allowance, 0)
        allowance.take(array.size, array.dtype.itemsize, "it")
    except HabitusError:
        raise
    except Exception as error:  # the state of a record may be anything
        reason = shown(f"{type(error).__name__}: {error}", 120)
        raise HabitusError(f"damaged array ({reason}); get the file again") from error
    if array.dtype.kind not in "biufU":
        raise HabitusError(
            f"an array of {array.dtype}; expected numbers or text; get the file again"
        )
    return array


def _array(value: Any, allowance: Allowance, depth: int) -> np.ndarray:
    if depth > _DEEPEST:
        raise HabitusError("a record within records without end; get the file again")
    if not isinstance(value, PickledObject):
        return _listed(value, allowance)
    kind, arguments, state = _unwrapped(value)
    if kind.startswith("scipy."):
        return _sparse(kind, state, allowance, depth)
    if kind == "chumpy.reordering.Select":
        source, chosen = (_array(state[key], allowance, depth + 1) for key in ("a", "idxs"))
        return source.ravel()[chosen].reshape(state.get("preferred_shape", -1))
    if kind.startswith("chumpy.") and isinstance(state, Mapping) and "x" in state:
        return _array(state["x"], allowance, depth + 1)
    if kind.endswith("._reconstruct") and state is not None:
        _, shape, dtype, fortran, data = state
        return np.frombuffer(dtype=_dtype(dtype), buffer=_bytes(data)).reshape(
            shape, order="F" if fortran else "C"
        )
    if kind.endswith("._frombuffer"):
        data, dtype, shape, order = arguments
        return np.frombuffer(dtype=_dtype(dtype), buffer=_bytes(data)).reshape(shape, order=order)
    if kind.endswith(".scalar"):
        return np.frombuffer(dtype=_dtype(arguments[0]), buffer=_bytes(arguments[1]))[0]
    raise HabitusError(
        f"an entry of kind {shown(kind)} where an array was expected; convert it to a plain array "
        "where it was made"
    )


def _listed(value: Any, allowance: Allowance) -> np.ndarray:
    """A number, a text or lists of them, counted first: lists that hold one list many times grow
    without end.
    """
    count, width = _weigh(value, 0)
    allowance.take(count, 4 * width, "it")
    return np.asarray(value)


def _weigh(value: Any, depth: int) -> tuple[int, int]:
    """How many entries nested lists unfold to, and the characters of the longest text in them."""
    if not isinstance(value, list | tuple):
        return 1, len(value) if isinstance(value, str | bytes) else 2
    if depth > _DEEPEST:
        raise HabitusError(f"lists nested more than {_DEEPEST} deep; expected an array")
    total = 1
    widest = 2
    for entry in value:
        count, width = _weigh(entry, depth + 1)
        total = total + count
        widest = max(widest, width)
        if total > MAX_PICKLE_STEPS:
            raise HabitusError(f"lists of more than {MAX_PICKLE_STEPS} entries; expected an array")
    return total, widest


def _unwrapped(record: PickledObject) -> tuple[str, tuple[Any, ...], Any]:
    """Name, arguments and state, seen through Python 2's way to construct objects."""
    if record.name == "copyreg._reconstructor":
        return record.arguments[0].name, (), record.state
    return record.name, record.arguments, record.state


def _sparse(kind: str, state: Mapping[str, Any], allowance: Allowance, depth: int) -> np.ndarray:
    data, starts, minor = (
        _array(state[key], allowance, depth + 1) for key in ("data", "indptr", "indices")
    )
    counts = np.diff(starts)
    if (counts < 0).any() or counts.sum() != len(minor):
        raise HabitusError("a sparse matrix whose rows do not add up; get the file again")
    shape = tuple(int(n) for n in state.get("_shape", state.get("shape")))
    allowance.take(array_size(shape), data.itemsize, "it")
    major = np.repeat(np.arange(len(starts) - 1), counts)
    rows, columns = (minor, major) if "csc" in kind else (major, minor)
    dense = np.zeros(shape, data.dtype)
    np.add.at(dense, (rows, columns), data)
    return dense


def _bytes(data: Any) -> bytes:
    """Raw bytes, which Python 2 wrote as text and Python 3 at old protocols as a call that encodes
    text.
    """
    if isinstance(data, PickledObject):
        data = data.arguments[0] if data.arguments else b""
    if not isinstance(data, str | bytes):
        raise HabitusError(
            f"the numbers of an array are a {type(data).__name__}; expected bytes; get the file "
            "anew"
        )
    return data.encode("latin1") if isinstance(data, str) else data


def _dtype(record: Any) -> np.dtype:
    code = record.arguments[0]
    if not (isinstance(code, str) and _NUMBER.fullmatch(code)):
        raise HabitusError(f"an array of {shown(code)!r}; expected numbers; get the file again")
    order = record.state[1] if record.state else "="
    return np.dtype(code).newbyteorder(order if order in ("<", ">") else "=")
