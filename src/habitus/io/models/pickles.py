"""Reads the plain content of model pickles without running any of the code that a pickle can name.

Python's own unpickler is not used: here a pickle is a list of steps that can set up texts, numbers,
lists and records, and there is no step that imports or calls. Every name on a short list (arrays of
numpy, sparse matrices of scipy, and the wrappers of chumpy around arrays) makes an inert record of
its arguments and state, from which `habitus.io.models.pickled_arrays.as_array` builds an array of
its own; any other name is refused. What is set up is no larger than the steps that set it up.
"""

import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

from habitus.errors import HabitusError, shown
from habitus.io.models.pickle_steps import pickle_steps

_MAPPING = "collections.OrderedDict"
_INERT = re.compile(
    r"""numpy\.(dtype|ndarray)
      | numpy\._?core\.(multiarray\.(_reconstruct|scalar)|numeric\._frombuffer)
      | numpy\.matrixlib\.defmatrix\.matrix
      | scipy\.sparse\._?cs[cr]\.cs[cr]_(matrix|array)
      | copyreg\._reconstructor
      | collections\.OrderedDict
      | builtins\.(object|bytes|set|frozenset)
      | _codecs\.encode
      | chumpy(\.\w+)+""",
    re.VERBOSE,
)
_PYTHON_2 = {"__builtin__": "builtins", "copy_reg": "copyreg"}


@dataclass(frozen=True)
class Name:
    """A name in a pickle, never looked up."""

    name: str


@dataclass(eq=False)
class Record:
    """What stands in for anything a pickle would construct: it keeps what it is given and does
    nothing.
    """

    name: str
    arguments: tuple[Any, ...]
    state: Any = None


def read_pickle(file: BinaryIO | bytes) -> Any:
    """The plain content of a pickle, with inert records in place of objects.

    Raises HabitusError for names that are no arrays and for files that are no whole pickles.
    """
    machine = _Machine()
    try:
        for code, argument in pickle_steps(file if isinstance(file, bytes) else file.read()):
            machine.step(code, argument)
        return machine.pop()
    except HabitusError as error:
        raise HabitusError(f"the pickle is refused: {error}") from error
    except Exception as error:  # a damaged pickle may raise anything
        told = shown(f"{type(error).__name__}: {error}", 120)
        raise HabitusError(f"this is no whole pickle ({told}); get the file anew") from error


def _checked(module: object, name: object) -> Name:
    if not (isinstance(module, str) and isinstance(name, str)):
        raise HabitusError("a name that is no text; get the file anew")
    qualified = f"{_PYTHON_2.get(module, module)}.{name}"
    if len(qualified) < 200 and _INERT.fullmatch(qualified):
        return Name(qualified)
    raise HabitusError(
        f"it asks for {shown(qualified)}; a body model holds only arrays: nothing was run, get "
        "the file anew"
    )


def _made(name: object, arguments: object) -> Any:
    """What calling a name gives: a record of it; an ordered mapping of pairs is a mapping."""
    if not (isinstance(name, Name) and isinstance(arguments, tuple | list)):
        raise HabitusError("it calls what is no name; nothing was run, get the file anew")
    if name.name == _MAPPING:
        filled: dict[Any, Any] = {}
        for pair in arguments[0] if arguments else ():
            key, value = pair
            filled[_key(key)] = value
        return filled
    return Record(name.name, tuple(arguments))


def _key(key: object) -> Any:
    """A key of a mapping: a text or small number; to hash anything else may take forever."""
    if isinstance(key, str) or (isinstance(key, int) and key.bit_length() <= 64):
        return key
    raise HabitusError(f"a key of kind {type(key).__name__}; expected texts; get the file anew")


class _Machine:
    """The stack, the marks on it and the memo of a pickle as its steps are followed."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def step(self, code: bytes, argument: Any) -> None:
        """Follow one step."""
        if code in _VALUES:
            self.stack.append(argument)
        else:
            _STEPS[code](self, argument)

    def pop(self) -> Any:
        """The value on top, taken off; never one below the last mark."""
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise HabitusError("it takes more than it has; get the file anew")
        return self.stack.pop()

    def since_mark(self) -> list[Any]:
        """All that was put since the last mark, taken off."""
        if not self.marks:
            raise HabitusError("a mark is missing; get the file anew")
        mark = self.marks.pop()
        taken = self.stack[mark:]
        del self.stack[mark:]
        return taken

    def push(self, value: Any) -> None:
        """Put a value on top."""
        self.stack.append(value)

    def top(self, kind: type) -> Any:
        """The value on top, which stays there and has to be of a kind."""
        value = self.pop()
        self.push(value)
        if not isinstance(value, kind):
            raise HabitusError(
                f"it adds to a {type(value).__name__} as to a {kind.__name__}; get the file anew"
            )
        return value

    def put(self, number: int) -> None:
        """Keep the value on top in the memo."""
        self.memo[number] = self.top(object)

    def recall(self, number: int) -> None:
        """Put a value of the memo on top."""
        self.push(self.memo[number])

    def take(self, count: int) -> tuple[Any, ...]:
        """The values on top, the topmost last, taken off."""
        return tuple(reversed([self.pop() for _ in range(count)]))

    def append(self, values: list[Any]) -> None:
        """Add to the list on top."""
        self.top(list).extend(values)

    def set_items(self, flat: list[Any]) -> None:
        """Add to the mapping on top."""
        filled = self.top(dict)
        if len(flat) % 2:
            raise HabitusError("a key without its value; get the file anew")
        for key, value in zip(flat[::2], flat[1::2], strict=True):
            filled[_key(key)] = value

    def mapping(self) -> None:
        """A mapping of all that was put since the last mark."""
        flat = self.since_mark()
        self.push({})
        self.set_items(flat)

    def build(self) -> None:
        """Give the record on top its state."""
        state = self.pop()
        self.top(Record).state = state

    def old_object(self) -> None:
        """A name and its arguments since the last mark."""
        name, *arguments = self.since_mark() or [None]
        self.push(_made(name, arguments))


def _refused(what: str) -> Callable[[_Machine, Any], None]:
    def act(machine: _Machine, argument: Any) -> None:
        raise HabitusError(
            f"it asks for {what}; a body model holds only arrays: nothing was run, get the file "
            "anew"
        )

    return act


_VALUES = frozenset(
    getattr(pickle, name)
    for name in "INT LONG FLOAT STRING UNICODE BININT BININT1 BININT2 BINFLOAT LONG1 LONG4 "
    "SHORT_BINSTRING BINSTRING "
    "SHORT_BINBYTES BINBYTES BINBYTES8 BYTEARRAY8 SHORT_BINUNICODE BINUNICODE BINUNICODE8".split()
)
_STEPS: Mapping[bytes, Callable[[_Machine, Any], object]] = {
    pickle.PROTO: lambda m, a: None,
    pickle.FRAME: lambda m, a: None,
    pickle.STOP: lambda m, a: None,
    pickle.NONE: lambda m, a: m.push(None),
    pickle.NEWTRUE: lambda m, a: m.push(True),
    pickle.NEWFALSE: lambda m, a: m.push(False),
    pickle.MARK: lambda m, a: m.marks.append(len(m.stack)),
    pickle.POP: lambda m, a: m.marks.pop() if m.marks and m.marks[-1] == len(m.stack) else m.pop(),
    pickle.POP_MARK: lambda m, a: m.since_mark(),
    pickle.DUP: lambda m, a: m.push(m.top(object)),
    **dict.fromkeys((pickle.PUT, pickle.BINPUT, pickle.LONG_BINPUT), lambda m, a: m.put(a)),
    **dict.fromkeys((pickle.GET, pickle.BINGET, pickle.LONG_BINGET), lambda m, a: m.recall(a)),
    pickle.MEMOIZE: lambda m, a: m.put(len(m.memo)),
    **dict.fromkeys((pickle.EMPTY_LIST, pickle.EMPTY_SET), lambda m, a: m.push([])),
    pickle.EMPTY_TUPLE: lambda m, a: m.push(()),
    pickle.EMPTY_DICT: lambda m, a: m.push({}),
    pickle.LIST: lambda m, a: m.push(m.since_mark()),
    **dict.fromkeys((pickle.TUPLE, pickle.FROZENSET), lambda m, a: m.push(tuple(m.since_mark()))),
    pickle.TUPLE1: lambda m, a: m.push(m.take(1)),
    pickle.TUPLE2: lambda m, a: m.push(m.take(2)),
    pickle.TUPLE3: lambda m, a: m.push(m.take(3)),
    pickle.DICT: lambda m, a: m.mapping(),
    pickle.APPEND: lambda m, a: m.append([m.pop()]),
    **dict.fromkeys((pickle.APPENDS, pickle.ADDITEMS), lambda m, a: m.append(m.since_mark())),
    pickle.SETITEM: lambda m, a: m.set_items(list(m.take(2))),
    pickle.SETITEMS: lambda m, a: m.set_items(m.since_mark()),
    pickle.GLOBAL: lambda m, a: m.push(_checked(*a)),
    pickle.STACK_GLOBAL: lambda m, a: m.push(_checked(*m.take(2))),
    **dict.fromkeys((pickle.REDUCE, pickle.NEWOBJ), lambda m, a: m.push(_made(*m.take(2)))),
    pickle.NEWOBJ_EX: lambda m, a: m.push(_made(*m.take(3)[:2])),
    pickle.INST: lambda m, a: m.push(_made(_checked(*a), m.since_mark())),
    pickle.OBJ: lambda m, a: m.old_object(),
    pickle.BUILD: lambda m, a: m.build(),
    **dict.fromkeys((pickle.EXT1, pickle.EXT2, pickle.EXT4), _refused("a registered class")),
    **dict.fromkeys((pickle.PERSID, pickle.BINPERSID), _refused("an object outside the file")),
    **dict.fromkeys(
        (pickle.NEXT_BUFFER, pickle.READONLY_BUFFER), _refused("memory outside the file")
    ),
}
