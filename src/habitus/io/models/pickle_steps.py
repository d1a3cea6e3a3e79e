"""A pickle taken apart into its steps, each an opcode and its argument; nothing is made or called.

Every length is held against the bytes that are there, and there are only so many steps.
"""

import codecs
import pickle
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from habitus.errors import HabitusError, shown
from habitus.io.limits import MOST_PICKLE_STEPS, check_present

_Argument = Callable[[bytes, int], tuple[Any, int]]


def pickle_steps(content: bytes) -> Iterator[tuple[bytes, Any]]:
    """Each step of a pickle as (opcode, argument), up to the one that ends it.

    Raises HabitusError where it ends early, claims more bytes than it has, or has steps without
    end.
    """
    position = 0
    for _ in range(MOST_PICKLE_STEPS):
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
    raise HabitusError(f"more than {MOST_PICKLE_STEPS} steps; expected a few large arrays")


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
        raise HabitusError("a text without its quotes; get the file anew")
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
