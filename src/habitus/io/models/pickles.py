"""Reads the arrays in model pickles without running any of the code that a pickle can name.

Nothing that a pickle names is imported or called. Every name on a short list (arrays of numpy, sparse matrices of
scipy, and the wrappers of chumpy around arrays) becomes an inert record of its arguments and state, from which
`as_array` builds an array of its own; any other name is refused.
"""

import pickle
import re
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

from habitus.errors import HabitusError

_PLAIN = {"collections.OrderedDict": OrderedDict, "builtins.set": set, "builtins.frozenset": frozenset}
_INERT = re.compile(
    r"""numpy\.(dtype|ndarray)
      | numpy\._?core\.(multiarray\.(_reconstruct|scalar)|numeric\._frombuffer)
      | numpy\.matrixlib\.defmatrix\.matrix
      | scipy\.sparse\._?cs[cr]\.cs[cr]_(matrix|array)
      | copyreg\._reconstructor
      | builtins\.(object|bytes)
      | _codecs\.encode
      | chumpy(\.\w+)+""",
    re.VERBOSE,
)
_PYTHON_2 = {"__builtin__": "builtins", "copy_reg": "copyreg"}
_NUMBER = re.compile(r"[<>=|]?([biuf][1248]|\?)")


class _Inert:
    """What stands in for anything a pickle would construct: it keeps what it is given and does nothing."""

    name = ""
    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any, **_: Any) -> "_Inert":
        record = object.__new__(cls)
        record.arguments = arguments
        record.state = None
        return record

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __hash__(self) -> int:
        return id(self)


class _InertUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        qualified = f"{_PYTHON_2.get(module, module)}.{name}"
        if qualified in _PLAIN:
            return _PLAIN[qualified]
        if _INERT.fullmatch(qualified):
            return type("_Inert", (_Inert,), {"name": qualified})
        raise HabitusError(
            f"the pickle asks for {qualified}; a body model holds only arrays: nothing was run, get the file anew"
        )


def read_pickle(file: BinaryIO) -> Any:
    """The plain content of a pickle, with inert records for `as_array` in place of objects.

    Raises HabitusError for names that are no arrays and for files that are no whole pickles.
    """
    try:
        return _InertUnpickler(file, encoding="latin1").load()
    except HabitusError:
        raise
    except Exception as error:  # a damaged pickle may raise anything
        raise HabitusError(f"this is no whole pickle ({type(error).__name__}: {error}); get the file anew") from error


def as_array(value: Any) -> np.ndarray:
    """The array that an entry of a pickle stands for; sparse matrices become dense.

    Raises HabitusError where the entry is no array of numbers and no text.
    """
    try:
        array = _array(value)
    except HabitusError:
        raise
    except Exception as error:  # the state of a record may be anything
        raise HabitusError(f"damaged array ({type(error).__name__}: {error}); get the file anew") from error
    if array.dtype.kind not in "biufU":
        raise HabitusError(f"an array of {array.dtype}; expected numbers or text; get the file anew")
    return array


def _array(value: Any) -> np.ndarray:
    if not isinstance(value, _Inert):
        return np.asarray(value)
    kind, arguments, state = _unwrapped(value)
    if kind.startswith("scipy."):
        return _sparse(kind, state)
    if kind == "chumpy.reordering.Select":
        return _array(state["a"]).ravel()[_array(state["idxs"])].reshape(state.get("preferred_shape", -1))
    if kind.startswith("chumpy.") and isinstance(state, Mapping) and "x" in state:
        return _array(state["x"])
    if kind.endswith("._reconstruct") and state is not None:
        _, shape, dtype, fortran, data = state
        return np.frombuffer(dtype=_dtype(dtype), buffer=_bytes(data)).reshape(shape, order="F" if fortran else "C")
    if kind.endswith("._frombuffer"):
        data, dtype, shape, order = arguments
        return np.frombuffer(dtype=_dtype(dtype), buffer=_bytes(data)).reshape(shape, order=order)
    if kind.endswith(".scalar"):
        return np.frombuffer(dtype=_dtype(arguments[0]), buffer=_bytes(arguments[1]))[0]
    raise HabitusError(
        f"an entry of kind {kind} where an array was expected; convert it to a plain array where it was made"
    )


def _unwrapped(record: _Inert) -> tuple[str, tuple[Any, ...], Any]:
    """Name, arguments and state, seen through Python 2's way to construct objects."""
    if record.name == "copyreg._reconstructor":
        return record.arguments[0].name, (), record.state
    return record.name, record.arguments, record.state


def _sparse(kind: str, state: Mapping[str, Any]) -> np.ndarray:
    data, starts, minor = (_array(state[key]) for key in ("data", "indptr", "indices"))
    major = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    rows, columns = (minor, major) if "csc" in kind else (major, minor)
    dense = np.zeros(tuple(int(n) for n in state.get("_shape", state.get("shape"))), data.dtype)
    np.add.at(dense, (rows, columns), data)
    return dense


def _bytes(data: Any) -> bytes:
    """Raw bytes, which Python 2 wrote as text and Python 3 at old protocols as a call that encodes text."""
    if isinstance(data, _Inert):
        return _bytes(data.arguments[0] if data.arguments else b"")
    return data.encode("latin1") if isinstance(data, str) else bytes(data)


def _dtype(record: Any) -> np.dtype:
    code = record.arguments[0]
    if not (isinstance(code, str) and _NUMBER.fullmatch(code)):
        raise HabitusError(f"an array of {code!r}; expected numbers; get the file anew")
    order = record.state[1] if record.state else "="
    return np.dtype(code).newbyteorder(order if order in "<>" else "=")
