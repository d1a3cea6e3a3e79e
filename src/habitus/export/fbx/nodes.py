"""Binary FBX 7: a tree of named nodes with typed values, between a header and a footer.

The format has no published specification; its layout is known from readers and writers under free
licences (ufbx and ufbx_write by Samuli Raivio among them).
"""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from habitus.errors import HabitusError
from habitus.io.motions.fbx_nodes import MAGIC, WIDE, FbxNode

VERSION = 7400
CREATED = "1970-01-01 10:00:00:000"
"""A file's time. Its two identities are checksums of that; files of one motion are the same to the
last byte.
"""
FILE_ID = bytes.fromhex("28b32aebb624ccc2bfc8b02aa92bfcf1")
_FOOTER_ID = bytes.fromhex("fabcab09d0c8d466b176fb831cf7267e")
_FOOTER_END = bytes.fromhex("f85a8c6adef5d97eece90ce3758f290b")
_ARRAYS = {"f4": b"f", "f8": b"d", "i4": b"i", "i8": b"l"}
_SINGLES: tuple[tuple[type, bytes, str], ...] = (
    (bool, b"C", "<?"),
    (np.int64, b"L", "<q"),
    (int, b"I", "<i"),
    (float, b"D", "<d"),
)  # bools are ints, too
_ALWAYS_A_SCOPE = frozenset({"AnimationStack", "AnimationLayer"})
"""Nodes that end with a null record although no node is in them, as in the files of other writers:
assimp, and with it Godot and others, reads no animation without.
"""
_LEAST_TO_PACK = 128
_LEVEL = 5
_LARGEST = 2**32 - 1


class Packed(bytes):
    """An array's value as it is written, made once for the many nodes that hold it."""


Value = str | bytes | bool | int | float | np.int64 | np.ndarray | Packed


@dataclass(frozen=True, eq=False)
class Node:
    """A node: its name, its values and the nodes in it.

    A Python int is written as a 32-bit number, ``np.int64`` as one of 64 bits, a float as a double,
    bool as one byte, str as text, bytes as they are; arrays of float32, float64, int32 and int64
    flat, packed where they are long. ``scope``: a null record ends its nodes though there are none.
    """

    name: str
    values: tuple[Value, ...] = ()
    nodes: Sequence["Node"] = ()
    scope: bool = False


def kept(node: FbxNode) -> Node:
    """A node of a file that was read, with its values unchanged."""
    return Node(
        node.name, tuple(map(Packed, node.encoded)), tuple(map(kept, node.nodes)), node.scope
    )


def packed(array: np.ndarray) -> Packed:
    """An array as a node's value is written."""
    flat = np.ascontiguousarray(array).reshape(-1)
    code = _ARRAYS.get(flat.dtype.str[1:])
    if code is None:
        raise TypeError(f"arrays of {flat.dtype} have no form in FBX")
    raw = flat.astype(flat.dtype.newbyteorder("<"), copy=False).tobytes()
    data = zlib.compress(raw, _LEVEL) if len(raw) > _LEAST_TO_PACK else raw
    return Packed(
        code + struct.pack("<III", len(flat), len(raw) > _LEAST_TO_PACK, len(data)) + data
    )


def document(nodes: Sequence[Node], version: int = VERSION, footer_id: bytes = _FOOTER_ID) -> bytes:
    """A whole file of these top nodes. Raises HabitusError where it exceeds the offsets of its
    version.
    """
    head = struct.Struct("<QQQB" if version >= WIDE else "<IIIB")
    parts = [MAGIC + struct.pack("<I", version)]
    at = len(parts[0])
    for node in nodes:
        parts.append(_encoded(node, at, head))
        at += len(parts[-1])
    footer = bytes(head.size) + footer_id
    padding = bytes(16 - (at + len(footer)) % 16)
    return b"".join(
        [*parts, footer, padding, struct.pack("<II", 0, version), bytes(120), _FOOTER_END]
    )


def _encoded(node: Node, at: int, head: struct.Struct) -> bytes:
    """A node's bytes, which begin ``at`` bytes into the file: ends are offsets in the file."""
    name = node.name.encode("latin-1")
    values = b"".join(map(_value, node.values))
    inside = at + head.size + len(name) + len(values)
    parts = []
    for child in node.nodes:
        parts.append(_encoded(child, inside, head))
        inside += len(parts[-1])
    if node.nodes or not node.values or node.scope or node.name in _ALWAYS_A_SCOPE:
        parts.append(bytes(head.size))
        inside += head.size
    if inside > _LARGEST and head.size < 20:
        raise HabitusError(
            "the FBX file would be larger than 4 GB, which its version cannot hold; lower --fps"
        )
    begin = head.pack(inside, len(node.values), len(values), len(name))
    return b"".join([begin, name, values, *parts])


def _value(value: Value) -> bytes:
    if isinstance(value, Packed):
        return value
    if isinstance(value, np.ndarray):
        return packed(value)
    if isinstance(value, str | bytes):
        raw = value.encode("utf-8") if isinstance(value, str) else value
        return (b"S" if isinstance(value, str) else b"R") + struct.pack("<I", len(raw)) + raw
    for kind, code, form in _SINGLES:
        if isinstance(value, kind):
            return code + struct.pack(form, value)
    raise TypeError(f"{type(value).__name__} has no form in FBX")
