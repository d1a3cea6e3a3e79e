"""Open Sound Control: messages of one shape sent again and again, filled with numbers in place.

Everything in OSC is aligned to four bytes and big-endian, so that a bundle is laid out once, and a
frame writes its numbers into it: some twenty microseconds, a fiftieth of what building messages
anew takes.
"""

import socket
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from habitus.errors import HabitusError

_IMMEDIATELY = b"#bundle\0" + (1).to_bytes(8, "big")
_LARGEST = 1400
"""Bytes of a datagram that no network cuts in pieces."""


class Message(NamedTuple):
    """An address, the kinds of its arguments ("s", "i", "f"), and the texts among these; numbers
    are filled in.
    """

    address: str
    kinds: str
    texts: tuple[str, ...] = ()


class Bundles:
    """Messages laid out in one bundle or more, none larger than a datagram should be."""

    def __init__(self, messages: Sequence[Message]):
        self._parts: list[np.ndarray] = []
        self._floats: list[tuple[int, int]] = []
        self._ints: list[tuple[int, int]] = []
        data = _IMMEDIATELY
        for message in messages:
            size = len(_encoded(message)[0])
            if len(data) + 4 + size > _LARGEST and len(data) > len(_IMMEDIATELY):
                self._parts.append(_words(data))
                data = _IMMEDIATELY
            data = self._add(data, message)
        self._parts.append(_words(data))

    def _add(self, data: bytes, message: Message) -> bytes:
        encoded, holes = _encoded(message)
        for kind, at in holes:
            (self._floats if kind == "f" else self._ints).append(
                (len(self._parts), (len(data) + 4 + at) // 4)
            )
        return data + len(encoded).to_bytes(4, "big") + encoded

    def filled(self, floats: Sequence[float] | np.ndarray, ints: Sequence[int] = ()) -> list[bytes]:
        """The datagrams with these numbers, each kind in the order of the messages."""
        single = np.asarray(floats, dtype=">f4")
        whole = np.asarray(ints, dtype=">i4")
        for k, part in enumerate(self._parts):
            for places, values in (
                (self._floats, single.view(">u4")),
                (self._ints, whole.view(">u4")),
            ):
                mine = [n for n, (where, _) in enumerate(places) if where == k]
                part[[places[n][1] for n in mine]] = values[mine]
        return [part.tobytes() for part in self._parts]


def _encoded(message: Message) -> tuple[bytes, list[tuple[str, int]]]:
    """A message with zeros for its numbers, and where these are."""
    data = _text(message.address) + _text(f",{message.kinds}")
    texts = iter(message.texts)
    holes = []
    for kind in message.kinds:
        if kind == "s":
            data += _text(next(texts))
        else:
            holes.append((kind, len(data)))
            data += bytes(4)
    return data, holes


def _text(words: str) -> bytes:
    """Ended by zeros, up to four bytes' multiple."""
    data = words.encode("ascii") + b"\0"
    return data + bytes(-len(data) % 4)


def _words(data: bytes) -> np.ndarray:
    return np.frombuffer(bytearray(data), dtype=">u4")


class Sender:
    """A UDP socket that sends to one address and never waits."""

    def __init__(self, host: str, port: int):
        try:
            family, _, _, _, self._to = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise HabitusError(
                f"no host {host!r} is known ({error.strerror}); check the address to send to"
            ) from None
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self.failed = 0

    def send(self, packets: Sequence[bytes]) -> None:
        """Send; what cannot be sent is counted in ``failed`` and forgotten."""
        for packet in packets:
            try:
                self._socket.sendto(packet, self._to)
            except OSError:
                self.failed += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
