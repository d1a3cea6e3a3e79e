"""Reads weights of face units live over OSC (UDP), as programs of ARKit's faces and of VMC send
them.

A message counts where it names a unit and gives a number: by its arguments (VMC's
``/VMC/Ext/Blend/Val "jawOpen" 0.5``, ``/blendshape "jawOpen" 0.5``) or by the end of its address
(``/face/jawOpen 0.5``). A datagram is a frame; units that it leaves out keep their weights.
"""

import select
import socket
import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.streams.natnet import received, stamped
from habitus.io.streams.source import Skipped, host_and_port

PORT = 39539
"""Where VMC's receivers listen."""
_AT_ONCE = 1000
_MAX_MESSAGES = 1000
_MAX_DEPTH = 4
_BUNDLE = b"#bundle\0"
_SIZES = {"f": ">f", "i": ">i", "d": ">d", "h": ">q"}


class FaceFrame(NamedTuple):
    """When a frame was there (`time.perf_counter`), and the weights (U,) of all units, 0 to 1."""

    arrived: float
    weights: Float[np.ndarray, " U"]


class FaceStream:
    """Frames of a sender of face units. ``names`` are the units (`BodyModel.face_unit_names`), in
    the order of the weights; their case does not count.

    address: the interface that is listened on, HOST or HOST:PORT; by itself this machine's
    loopback, 0.0.0.0 for all. Whatever cannot be read is counted in ``skipped``. Raises
    HabitusError where nothing can be listened to there.
    """

    def __init__(self, names: Sequence[str], address: object = None):
        if not names:
            raise HabitusError("no face units were named; expected those of a body with a face")
        host, port = host_and_port(address, PORT)
        self.name = f"faces {host}:{port}"
        self.ended = False
        self.skipped = Skipped()
        self._place = {name.lower(): k for k, name in enumerate(names)}
        self._weights = np.zeros(len(names))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            stamped(self._socket).bind((host, port))
        except OSError as error:
            self._socket.close()
            raise HabitusError(
                f"{self.name}: cannot listen there ({error.strerror}); give another address or "
                "close what listens"
            ) from None

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    def poll(self, timeout: float) -> list[FaceFrame]:
        """The frames that are there, waiting for the first of them for at most so many seconds."""
        if self.ended or not select.select([self._socket], [], [], timeout)[0]:
            return []
        frames = []
        for _ in range(_AT_ONCE):
            packet = received(self._socket)
            if packet is None:
                break
            if self._take(packet[0]):
                frames.append(FaceFrame(packet[1], self._weights.copy()))
        return frames

    def close(self) -> None:
        """Close the socket."""
        self.ended = True
        self._socket.close()

    def _take(self, packet: bytes) -> bool:
        """Whether a datagram said anything of a unit."""
        try:
            messages = list(read_messages(packet))
        except ValueError as error:
            self.skipped.add(str(error))
            return False
        found = False
        for address, values in messages:
            name = values[0] if values and isinstance(values[0], str) else address.split("/")[-1]
            unit = self._place.get(name.lower())
            numbers = [value for value in values if not isinstance(value, str)]
            if unit is None or not numbers or not np.isfinite(numbers[0]):
                continue
            self._weights[unit] = min(max(float(numbers[0]), 0.0), 1.0)
            found = True
        if not found:
            self.skipped.add("packets without a face unit")
        return found


def read_messages(packet: bytes, depth: int = 0) -> Iterator[tuple[str, list[str | float]]]:
    """Address and arguments of each message of an OSC packet, bundles unpacked.

    Raises ValueError, a noun phrase in the plural, for what is no OSC, and for more than a face can
    need.
    """
    if not packet.startswith(_BUNDLE):
        yield _read_message(packet)
        return
    if depth >= _MAX_DEPTH:
        raise ValueError("packets of bundles in bundles")
    at = len(_BUNDLE) + 8
    count = 0
    while at < len(packet):
        size = int.from_bytes(packet[at : at + 4], "big")
        part = packet[at + 4 : at + 4 + size]
        count += 1
        if not size or len(part) != size or count > _MAX_MESSAGES:
            raise ValueError("truncated or overlong bundles")
        yield from read_messages(part, depth + 1)
        at += 4 + size


def _read_message(packet: bytes) -> tuple[str, list[str | float]]:
    address, at = _read_text(packet, 0)
    if not address.startswith("/"):
        raise ValueError("packets that are no OSC")
    if at >= len(packet):
        return address, []
    kinds, at = _read_text(packet, at)
    values: list[str | float] = []
    for kind in kinds.removeprefix(","):
        if kind in "sS":
            text, at = _read_text(packet, at)
            values.append(text)
        elif kind in "TF":
            values.append(float(kind == "T"))
        elif kind in _SIZES:
            layout = struct.Struct(_SIZES[kind])
            if at + layout.size > len(packet):
                raise ValueError("truncated messages")
            values.append(float(layout.unpack_from(packet, at)[0]))
            at += layout.size
        else:
            raise ValueError("messages with arguments of other kinds")
    return address, values


def _read_text(packet: bytes, at: int) -> tuple[str, int]:
    end = packet.find(b"\0", at)
    if end < 0:
        raise ValueError("packets that are no OSC")
    return packet[at:end].decode("utf-8", "replace"), end + 4 - end % 4
