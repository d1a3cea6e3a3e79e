"""NatNet packets, as OptiTrack's Motive sends them: what is in them of markers, for bitstream
versions 3.0 to 4.2.

The package natnet is not used: it takes a fifth of a millisecond for five markers, reads nine of a
force plate's twelve corner coordinates, so that what stands behind a plate in a model definition is
garbage, and a packet that it cannot read ends the thread that receives. All numbers are
little-endian.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

CONNECT = 0
SERVER_INFO = 1
REQUEST = 2
RESPONSE = 3
REQUEST_MODEL = 4
MODEL = 5
FRAME = 7
KEEP_ALIVE = 10
UNRECOGNISED = 100
OLDEST = (3, 0)

_LABELLED = np.dtype(
    [("id", "<u4"), ("place", "<f4", 3), ("size", "<f4"), ("flags", "<u2"), ("residual", "<f4")]
)
_OCCLUDED = 0x01
_UNLABELLED = 0x10
_MODELS_CHANGED = 0x02
_BONE = 4 + 28 + 4 + 2
"""Bytes of a rigid body in a frame: id, place and quaternion, error, flags."""


class BadPacket(Exception):
    """A packet that is truncated, or no NatNet; the message is a noun phrase in the plural."""


_TRUNCATED = "truncated packets"


class Server(NamedTuple):
    """Who answers: the program, its bitstream version, and where its frames go (multicast group
    None for unicast).
    """

    name: str
    version: tuple[int, int]
    data_port: int
    group: str | None


@dataclass(frozen=True)
class Model:
    """A model definition: labels ``set:marker`` (P,) of all marker sets, where each set begins, and
    which model's id in frames is which set's (set name -> first column and count; id -> set name).
    """

    labels: tuple[str, ...]
    sets: Mapping[str, tuple[int, int]]
    ids: Mapping[int, str]


class MarkerFrame(NamedTuple):
    """A frame: its number, points (P, 3), NaN where missing, and whether the server says that its
    models changed.
    """

    number: int
    points: Float[np.ndarray, "P 3"]
    changed: bool


class _Reader:
    """A cursor over a packet's bytes."""

    def __init__(self, data: bytes, at: int = 4):
        self.data = data
        self.at = at

    def skip(self, size: int) -> None:
        if size < 0 or self.at + size > len(self.data):
            raise BadPacket(_TRUNCATED)
        self.at += size

    def take(self, form: str) -> tuple:
        at = self.at
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self.data, at)

    def count(self, size: int = 1) -> int:
        """A number of things of at least so many bytes each."""
        (count,) = self.take("i")
        if count < 0 or self.at + count * size > len(self.data):
            raise BadPacket(_TRUNCATED)
        return count

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise BadPacket(_TRUNCATED)
        text = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text

    def array(self, kind: np.dtype, count: int) -> np.ndarray:
        at = self.at
        self.skip(kind.itemsize * count)
        return np.frombuffer(self.data, kind, count, at)


def message(kind: int, payload: bytes = b"") -> bytes:
    """A packet."""
    return struct.pack("<HH", kind, len(payload)) + payload


def connect_message(name: bytes = b"habitus") -> bytes:
    """What asks a server who it is: a name of 256 bytes, a version, and the bitstream version that
    is understood.
    """
    return message(CONNECT, name.ljust(256, b"\0") + bytes((0, 0, 0, 0)) + bytes((*OLDEST, 0, 0)))


def kind_of(packet: bytes) -> int:
    """The packet's kind. Raises BadPacket where its length is another than it says."""
    if len(packet) < 4:
        raise BadPacket(_TRUNCATED)
    kind, size = struct.unpack_from("<HH", packet)
    if len(packet) - 4 < size:
        raise BadPacket(_TRUNCATED)
    return kind


def read_server(packet: bytes) -> Server:
    """A server's answer to `connect_message`. Raises BadPacket."""
    reader = _Reader(packet)
    name = reader.take("256s")[0].partition(b"\0")[0].decode("utf-8", "replace")
    reader.skip(4)
    major, minor, _, _ = reader.take("4B")
    if (major, minor) < OLDEST:
        return Server(name, (major, minor), 0, None)
    _, port, multicast = reader.take("QHB")
    group = ".".join(map(str, reader.take("4B")))
    return Server(name, (major, minor), port, group if multicast else None)


def read_model(packet: bytes, version: tuple[int, int]) -> Model:
    """A model definition. Raises BadPacket."""
    reader = _Reader(packet)
    sets = dict[str, list[str]]()
    ids = dict[int, str]()
    sized = version >= (4, 1)
    for _ in range(reader.count(8 if sized else 4)):
        (kind,) = reader.take("i")
        if not sized:
            if kind != _MARKER_SET and kind not in _DESCRIPTIONS:
                break  # of unknown length: what follows cannot be found
            _describe(reader, kind, version, sets, ids)
            continue
        size = reader.count()
        part = _Reader(reader.data[: reader.at + size], reader.at)
        try:
            _describe(part, kind, version, sets, ids)
        except BadPacket:
            if kind == _MARKER_SET:
                raise
            # another description than is known here: its size says where the next one begins
        reader.skip(size)
    return _model(sets, ids)


def _describe(
    reader: _Reader,
    kind: int,
    version: tuple[int, int],
    sets: dict[str, list[str]],
    ids: dict[int, str],
) -> None:
    """Read one description into ``sets`` or ``ids``. Raises BadPacket."""
    if kind == _MARKER_SET:
        name = reader.text()
        sets[name] = [reader.text() for _ in range(reader.count())]
    elif kind in _DESCRIPTIONS:
        named = _DESCRIPTIONS[kind](reader, version)
        if named is not None:
            ids[named[0]] = named[1]


def _model(sets: Mapping[str, list[str]], ids: Mapping[int, str]) -> Model:
    """Without the set of all markers, which repeats those of the others."""
    labels = list[str]()
    places = {}
    for name, markers in sets.items():
        if name.lower() != "all" or len(sets) == 1:
            places[name] = (len(labels), len(markers))
            labels += [
                f"{name}:{marker.removeprefix(name).lstrip('_:') or marker}" for marker in markers
            ]
    return Model(tuple(labels), places, {id_: name for id_, name in ids.items() if name in places})


def _bone(reader: _Reader, version: tuple[int, int]) -> tuple[int, str]:
    name = reader.text()
    id_, _ = reader.take("ii")
    reader.skip(12)
    if version >= (4, 2):
        reader.skip(16)
    markers = reader.count(16)
    reader.skip(16 * markers)
    if version >= (4, 0):
        for _ in range(markers):
            reader.text()
    return id_, name


def _skeleton(reader: _Reader, version: tuple[int, int]) -> tuple[int, str]:
    name, (id_,) = reader.text(), reader.take("i")
    for _ in range(reader.count()):
        _bone(reader, version)
    return id_, name


def _asset(reader: _Reader, version: tuple[int, int]) -> tuple[int, str]:
    name, (_, id_) = reader.text(), reader.take("ii")
    for _ in range(reader.count()):
        _bone(reader, version)
    for _ in range(reader.count()):
        reader.text()
        reader.skip(4 + 12 + 4 + 2)
    return id_, name


def _plate(reader: _Reader, version: tuple[int, int]) -> None:
    reader.skip(4)
    reader.text()
    reader.skip(4 * (2 + 3 + 12 * 12 + 4 * 3 + 2))
    for _ in range(reader.count()):
        reader.text()


def _device(reader: _Reader, version: tuple[int, int]) -> None:
    reader.skip(4)
    reader.text()
    reader.text()
    reader.skip(8)
    for _ in range(reader.count()):
        reader.text()


def _camera(reader: _Reader, version: tuple[int, int]) -> None:
    reader.text()
    reader.skip(28)


_MARKER_SET = 0
_DESCRIPTIONS = {1: _bone, 2: _skeleton, 3: _plate, 4: _device, 5: _camera, 6: _asset}


def read_frame(packet: bytes, version: tuple[int, int], model: Model) -> MarkerFrame:
    """A frame's markers on a model. Raises BadPacket."""
    reader = _Reader(packet)
    points = np.full((len(model.labels), 3), np.nan)
    sized = version >= (4, 1)
    (number,) = reader.take("i")
    _read_sets(reader, sized, model, points)
    reader.skip(12 * _section(reader, sized))  # points without a label
    reader.skip(_BONE * _section(reader, sized))
    for _ in range(_section(reader, sized)):  # skeletons
        reader.skip(4)
        reader.skip(_BONE * reader.count())
    for _ in range(_section(reader, sized) if sized else 0):  # assets
        reader.skip(4)
        reader.skip(_BONE * reader.count())
        reader.skip(_LABELLED.itemsize * reader.count())
    _place(reader.array(_LABELLED, _section(reader, sized)), model, points)
    for _ in range(2):  # force plates, devices
        for _ in range(_section(reader, sized)):
            reader.skip(4)
            for _ in range(reader.count(4)):
                reader.skip(4 * reader.count(4))
    reader.skip(4 + 4 + 8 + 3 * 8 + (8 if sized else 0))
    points[~np.isfinite(points).all(axis=1)] = np.nan
    return MarkerFrame(number, points, bool(reader.take("H")[0] & _MODELS_CHANGED))


def _section(reader: _Reader, sized: bool) -> int:
    """How many things come; from 4.1 on their size in bytes follows."""
    count = reader.count()
    if sized:
        reader.skip(4)
    return count


def _read_sets(reader: _Reader, sized: bool, model: Model, points: np.ndarray) -> None:
    """Places by marker sets: they count for sets whose markers are not told one by one, with what
    is occluded.
    """
    labelled = set(model.ids.values())
    for _ in range(_section(reader, sized)):
        name = reader.text()
        count = reader.count(12)
        places = reader.array(np.dtype("<f4"), 3 * count).reshape(-1, 3)
        first, size = model.sets.get(name, (0, -1))
        if size == count and name not in labelled:
            points[first : first + count] = np.where(
                places.any(axis=1, keepdims=True), places, np.nan
            )


def _place(markers: np.ndarray, model: Model, points: np.ndarray) -> None:
    """Labelled markers that are seen, not filled in by the program, at their columns."""
    seen = markers[(markers["flags"] & (_OCCLUDED | _UNLABELLED)) == 0]
    owner = seen["id"] >> 16
    index = (seen["id"] & 0xFFFF).astype(np.int64) - 1
    for id_, name in model.ids.items():
        first, count = model.sets[name]
        mine = (owner == id_) & (index >= 0) & (index < count)
        points[first + index[mine]] = seen["place"][mine]
