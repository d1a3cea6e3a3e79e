"""The tree of nodes in an FBX file, binary 7.x or text, with its values as the file holds them.

Autodesk publishes no description of the format; its layout is known from readers under free
licences (ufbx by Samuli Raivio, Blender's notes "FBX binary file format specification").
"""

import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_TEXT_BYTES, Allowance, check_present, check_text

MAGIC = b"Kaydara FBX Binary  \x00\x1a\x00"
OLDEST = 7000
WIDE = 7500
"""Version from which on offsets in the file have 64 bits."""
MAX_LEVELS = 48
NODE_BYTES = 400
"""Memory of a node without its values, approximately."""
_SINGLES = {b"C": "<?", b"B": "<?", b"Y": "<h", b"I": "<i", b"F": "<f", b"D": "<d", b"L": "<q"}
_ARRAYS = {b"f": "<f4", b"d": "<f8", b"i": "<i4", b"l": "<i8", b"b": "i1", b"c": "i1"}
_SIZES = {code: struct.calcsize(form) for code, form in _SINGLES.items()}

FbxValue = bool | int | float | str | bytes | np.ndarray


@dataclass(frozen=True, eq=False)
class FbxNode:
    """A node: its name, its values as encoded in a binary file, and its child nodes.

    ``scope``: whether a null record ends the list of children, even of none.
    """

    name: str
    encoded: tuple[bytes, ...]
    nodes: tuple["FbxNode", ...] = ()
    scope: bool = False

    @property
    def values(self) -> list[FbxValue]:
        """The values. Raises HabitusError for damaged ones."""
        return [_decoded(each) for each in self.encoded]

    def value(self, number: int = 0) -> FbxValue | None:
        """One value; None where there are fewer."""
        return _decoded(self.encoded[number]) if number < len(self.encoded) else None

    def array(self) -> np.ndarray:
        """The first value, which must be an array. Raises HabitusError."""
        value = self.value()
        if not isinstance(value, np.ndarray):
            raise HabitusError(f"{shown(self.name)} holds no array; export the file again")
        return value

    def first(self, name: str) -> "FbxNode | None":
        """The first child with a name."""
        return next((node for node in self.nodes if node.name == name), None)

    def all(self, name: str) -> Iterator["FbxNode"]:
        """The children with a name."""
        return (node for node in self.nodes if node.name == name)


@dataclass(frozen=True, eq=False)
class FbxDocument:
    """Version and top nodes of a file, and the bytes after them; ``footer`` is empty for text."""

    version: int
    nodes: tuple[FbxNode, ...]
    footer: bytes
    text: bool

    def first(self, name: str) -> FbxNode:
        """The first top node with a name. Raises HabitusError where there is none."""
        for node in self.nodes:
            if node.name == name:
                return node
        raise HabitusError(f"no {name} in it; expected an FBX scene")


def read_document(content: bytes) -> FbxDocument:
    """The document in the bytes of a file. Raises HabitusError."""
    if content.startswith(MAGIC):
        return _binary(content)
    check_text(len(content), "the file", MAX_TEXT_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise HabitusError("neither binary nor text; expected an FBX file") from None
    return _of_text(text)


def _checked_version(version: int) -> int:
    if not OLDEST <= version < 10_000:
        raise HabitusError(
            f"FBX version {version}; expected 7.0 or later: export it again as FBX 2011 or later"
        )
    return version


# -- binary ----------------------------------------------------------------------------------------


def _binary(content: bytes) -> FbxDocument:
    if len(content) < len(MAGIC) + 4:
        raise HabitusError("the file ends in its header; get it again")
    version = _checked_version(struct.unpack_from("<I", content, len(MAGIC))[0])
    reader = _Binary(content, version)
    nodes, at = reader.nodes(len(MAGIC) + 4, len(content), 0)
    return FbxDocument(version, nodes, content[at:], False)


class _Binary:
    def __init__(self, content: bytes, version: int) -> None:
        self.content = content
        self.head = struct.Struct("<QQQB" if version >= WIDE else "<IIIB")
        self.allowance = Allowance(len(content))

    def nodes(self, at: int, end: int, level: int) -> tuple[tuple[FbxNode, ...], int]:
        """Nodes up to a null record, and where that ends."""
        if level > MAX_LEVELS:
            raise HabitusError("nodes nested without end")
        found: list[FbxNode] = []
        while at < end:
            if at + self.head.size > end:
                raise HabitusError("the file ends in the middle of a node; get it again")
            after, count, size, length = self.head.unpack_from(self.content, at)
            if not after:
                return tuple(found), at + self.head.size
            begin = at + self.head.size + length
            if not begin + size <= after <= end:
                raise HabitusError("a node goes beyond what holds it; get the file again")
            self.allowance.take_bytes(NODE_BYTES, "its tree of nodes")
            name = self.content[begin - length : begin].decode("latin-1")
            encoded = self.values(begin, begin + size, count)
            inside: tuple[FbxNode, ...] = ()
            scope = after > begin + size
            if scope:
                inside, _ = self.nodes(begin + size, after, level + 1)
            found.append(FbxNode(name, encoded, inside, scope))
            at = after
        return tuple(found), at

    def values(self, at: int, end: int, count: int) -> tuple[bytes, ...]:
        found = []
        for _ in range(count):
            if at >= end:
                raise HabitusError("a node has fewer values than it claims; get the file again")
            after = at + 1 + self.size(self.content[at : at + 1], at + 1, end)
            if after > end:
                raise HabitusError("a value goes beyond its node; get the file again")
            self.allowance.take_bytes(64, "its values")
            found.append(self.content[at:after])
            at = after
        return tuple(found)

    def size(self, code: bytes, at: int, end: int) -> int:
        """Bytes of a value with this type code; arrays are taken from the allowance."""
        if code in _SIZES:
            return _SIZES[code]
        if code in (b"S", b"R") and at + 4 <= end:
            return 4 + struct.unpack_from("<I", self.content, at)[0]
        if code in _ARRAYS and at + 12 <= end:
            count, _, stored = struct.unpack_from("<III", self.content, at)
            self.allowance.take(count, np.dtype(_ARRAYS[code]).itemsize, "an array in it")
            return 12 + stored
        raise HabitusError(f"a value of type {shown(code.decode('latin-1'))}; get the file again")


def _decoded(encoded: bytes) -> FbxValue:
    code, raw = encoded[:1], encoded[1:]
    if code in _SINGLES:
        return struct.unpack(_SINGLES[code], raw)[0]
    if code == b"S":
        return raw[4:].decode("utf-8", "replace")
    if code == b"R":
        return raw[4:]
    kind = np.dtype(_ARRAYS[code])
    count, packed, _ = struct.unpack_from("<III", raw)
    data = raw[12:]
    if packed:
        data = _inflated(data, count * kind.itemsize)
    check_present(count * kind.itemsize, len(data), "an array")
    return np.frombuffer(data, kind, count)


def _inflated(data: bytes, size: int) -> bytes:
    try:
        return zlib.decompressobj().decompress(data, size + 1)
    except zlib.error as error:
        raise HabitusError(f"a packed array is damaged ({error}); get the file again") from error


# -- text ------------------------------------------------------------------------------------------

_TOKENS = re.compile(
    r'[ \t\r\n]*+(?:;[^\n]*+[\r\n \t]*+)*+(?:"([^"]*+)"|([A-Za-z_][\w|.]*+)[ \t]*+:|([{},])|'
    r"(\*\d{1,12})|([^\s,{}:\";]++))"
)
_ARRAY = re.compile(r"[ \t\r\n]*+\{[ \t\r\n]*+a:([^}]*+)\}")
_BARE = {"T": True, "Y": True, "W": True, "F": False, "N": False}


def _of_text(text: str) -> FbxDocument:
    if "FBXHeaderExtension" not in text[:4000]:
        raise HabitusError("no FBXHeaderExtension; expected an FBX file, binary or text")
    reader = _Text(text)
    nodes = reader.nodes(0)
    document = FbxDocument(OLDEST, nodes, b"", True)
    version = document.first("FBXHeaderExtension").first("FBXVersion")
    claimed = version.value() if version is not None else None
    return FbxDocument(_checked_version(claimed if type(claimed) is int else 0), nodes, b"", True)


class _Text:
    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.allowance = Allowance(len(text))

    def token(self) -> tuple[str | None, ...] | None:
        """The next token's text by its kind: string, name, mark, array, word; None at the end."""
        match = _TOKENS.match(self.text, self.at)
        if match is None:
            if self.text[self.at :].strip() and not self.text[self.at :].lstrip().startswith(";"):
                raise HabitusError(
                    f"{shown(self.text[self.at : self.at + 30])} in the text; expected FBX"
                )
            return None
        self.before, self.at = self.at, match.end()
        return match.groups()

    def nodes(self, level: int) -> tuple[FbxNode, ...]:
        """Nodes up to the end of a scope."""
        if level > MAX_LEVELS:
            raise HabitusError("nodes nested without end")
        found: list[FbxNode] = []
        while (token := self.token()) is not None:
            _, name, mark, _, _ = token
            if mark == "}" and level:
                return tuple(found)
            if name is None:
                raise HabitusError(f"{shown(next(filter(None, token), ''), 40)}: expected a node")
            self.allowance.take_bytes(NODE_BYTES, "its tree of nodes")
            found.append(self.node(name, level))
        if level:
            raise HabitusError("the text ends in the middle of a node; get it again")
        return tuple(found)

    def node(self, name: str, level: int) -> FbxNode:
        encoded: list[bytes] = []
        while (token := self.token()) is not None:
            string, another, mark, array, word = token
            if another is not None or mark == "}":
                self.at = self.before
                break
            if mark == "{":
                return FbxNode(name, tuple(encoded), self.nodes(level + 1), True)
            if array is not None:
                return FbxNode(name, (*encoded, self.array(int(array[1:]))))
            if mark == ",":
                continue
            self.allowance.take_bytes(64, "its values")
            encoded.append(_text_value(string) if string is not None else _word(str(word)))
        return FbxNode(name, tuple(encoded))

    def array(self, count: int) -> bytes:
        match = _ARRAY.match(self.text, self.at)
        if match is None:
            raise HabitusError("an array without its numbers; get the file again")
        self.at = match.end()
        self.allowance.take(count, 16, "an array in it")
        words: Sequence[str] = match[1].split(",") if match[1].strip() else ()
        if len(words) != count:
            raise HabitusError(f"an array of {len(words)} numbers that claims {count}")
        try:
            whole = not any(mark in match[1] for mark in ".eEnN")
            numbers = np.array(words, "<i8" if whole else "<f8")
        except (ValueError, OverflowError):
            raise HabitusError("an array with words that are no numbers") from None
        code = b"l" if whole else b"d"
        return code + struct.pack("<III", count, 0, numbers.nbytes) + numbers.tobytes()


def _text_value(text: str) -> bytes:
    """A string; ``Model::Hips`` is in binary files ``Hips``, two control bytes and ``Model``."""
    kind, mark, name = text.replace("&quot;", '"').partition("::")
    raw = (f"{name}\0\1{kind}" if mark else kind).encode("utf-8", "replace")
    return b"S" + struct.pack("<I", len(raw)) + raw


def _word(word: str) -> bytes:
    if word in _BARE:
        return b"C" + struct.pack("<?", _BARE[word])
    try:
        if re.fullmatch(r"[+-]?\d{1,19}", word):
            return b"L" + struct.pack("<q", int(word))
        return b"D" + struct.pack("<d", float(word))
    except (ValueError, struct.error):
        raise HabitusError(f"{shown(word, 40)} in the text; expected a number") from None
