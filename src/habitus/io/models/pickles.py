"""Reads the data of a pickle without running any code that it names."""

import codecs
import pickle
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_PICKLE_STEPS, check_present

_Argument = Callable[[bytes, int], tuple[Any, int]]


def pickle_steps(content: bytes) -> Iterator[tuple[bytes, Any]]:
    """Each step of a pickle as (opcode, argument), up to the one that ends it.

    Raises HabitusError where it ends early, claims more bytes than it has, or has steps without
    end.
    """
    position = 0
    for _ in range(MAX_PICKLE_STEPS):
        code = content[position : position + 1]
        read = _ARGUMENTS.get(code)
        if read is None:
            raise HabitusError(
                f"{f'an unknown step {shown(code)}' if code else 'it ends early'}; get the file "
                "anew"
            )
        argument, position = read(content, position + 1)
        yield code, argument
        if code == pickle.STOP:
            return
    raise HabitusError(f"more than {MAX_PICKLE_STEPS} steps; expected a few large arrays")


def _nothing(content: bytes, at: int) -> tuple[None, int]:
    return None, at


def _line(decode: Callable[[bytes], Any]) -> _Argument:
    def read(content: bytes, at: int) -> tuple[Any, int]:
        end = content.find(b"\n", at)
        check_present(at if end >= 0 else len(content) + 1, len(content), "a line of it")
        return decode(content[at:end]), end + 1

    return read


def _number(form: str) -> _Argument:
    packed = struct.Struct(form)

    def read(content: bytes, at: int) -> tuple[Any, int]:
        check_present(at + packed.size, len(content), "a number of it")
        return packed.unpack_from(content, at)[0], at + packed.size

    return read


def _counted(form: str, decode: Callable[[bytes], Any]) -> _Argument:
    length = _number(form)

    def read(content: bytes, at: int) -> tuple[Any, int]:
        count, at = length(content, at)
        check_present(count, len(content) - at, "a text or array in it")
        return decode(content[at : at + count]), at + count

    return read


def _two_lines(content: bytes, at: int) -> tuple[tuple[str, str], int]:
    first, at = _line(bytes.decode)(content, at)
    second, at = _line(bytes.decode)(content, at)
    return (first, second), at


def _latin(raw: bytes) -> str:
    """Text as Python 2 wrote it, which is often the bytes of an array."""
    return raw.decode("latin1")


def _utf8(raw: bytes) -> str:
    return raw.decode("utf-8", "surrogatepass")


def _quoted(line: bytes) -> str:
    line = line.strip()
    if len(line) < 2 or line[:1] not in b"'\"" or line[:1] != line[-1:]:
        raise HabitusError("a text without its quotes; get the file again")
    return _latin(codecs.escape_decode(line[1:-1])[0])  # type: ignore


def _whole(line: bytes) -> int | bool:
    if line in (b"00", b"01"):
        return line == b"01"
    return int(line.strip().removesuffix(b"L"), 0)


def _long(raw: bytes) -> int:
    return int.from_bytes(raw, "little", signed=True)


_BY_KIND: Mapping[_Argument, str] = {
    _nothing: "MARK STOP POP POP_MARK DUP NONE REDUCE APPEND BUILD DICT EMPTY_DICT APPENDS LIST "
    "EMPTY_LIST OBJ SETITEM "
    "TUPLE EMPTY_TUPLE SETITEMS NEWOBJ TUPLE1 TUPLE2 TUPLE3 NEWTRUE NEWFALSE EMPTY_SET ADDITEMS "
    "FROZENSET NEWOBJ_EX "
    "STACK_GLOBAL MEMOIZE BINPERSID NEXT_BUFFER READONLY_BUFFER",
    _two_lines: "GLOBAL INST",
    _line(_whole): "INT LONG GET PUT",
    _line(float): "FLOAT",
    _line(_quoted): "STRING",
    _line(lambda line: line.decode("raw-unicode-escape")): "UNICODE",
    _line(bytes): "PERSID",
    _number("<B"): "BININT1 BINGET BINPUT PROTO EXT1",
    _number("<H"): "BININT2 EXT2",
    _number("<i"): "BININT EXT4",
    _number("<I"): "LONG_BINGET LONG_BINPUT",
    _number(">d"): "BINFLOAT",
    _number("<Q"): "FRAME",
    _counted("<B", _long): "LONG1",
    _counted("<i", _long): "LONG4",
    _counted("<B", _latin): "SHORT_BINSTRING",
    _counted("<i", _latin): "BINSTRING",
    _counted("<B", bytes): "SHORT_BINBYTES",
    _counted("<I", bytes): "BINBYTES",
    _counted("<Q", bytes): "BINBYTES8 BYTEARRAY8",
    _counted("<B", _utf8): "SHORT_BINUNICODE",
    _counted("<I", _utf8): "BINUNICODE",
    _counted("<Q", _utf8): "BINUNICODE8",
}
_ARGUMENTS = {
    getattr(pickle, name): read for read, names in _BY_KIND.items() for name in names.split()
}


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
class PickledObject:
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
        reason = shown(f"{type(error).__name__}: {error}", 120)
        raise HabitusError(
            f"this is not a complete pickle ({reason}); get the file again"
        ) from error


def _checked(module: object, name: object) -> Name:
    if not (isinstance(module, str) and isinstance(name, str)):
        raise HabitusError("a name that is not text; get the file again")
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
        raise HabitusError("it calls something without a name; nothing was run, get the file again")
    if name.name == _MAPPING:
        filled: dict[Any, Any] = {}
        for pair in arguments[0] if arguments else ():
            key, value = pair
            filled[_key(key)] = value
        return filled
    return PickledObject(name.name, tuple(arguments))


def _key(key: object) -> Any:
    """A key of a mapping: a text or small number; to hash anything else may take forever."""
    if isinstance(key, str) or (isinstance(key, int) and key.bit_length() <= 64):
        return key
    raise HabitusError(f"a key of kind {type(key).__name__}; expected texts; get the file again")


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
            raise HabitusError("it takes more than it has; get the file again")
        return self.stack.pop()

    def since_mark(self) -> list[Any]:
        """All that was put since the last mark, taken off."""
        if not self.marks:
            raise HabitusError("a mark is missing; get the file again")
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
                f"it adds to a {type(value).__name__} as to a {kind.__name__}; get the file again"
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
            raise HabitusError("a key without its value; get the file again")
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
        self.top(PickledObject).state = state

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
