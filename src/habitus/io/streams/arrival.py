"""Datagrams and when they were there: as the kernel says where it does (Linux), else when they are
read.
"""

import socket
import struct
import sys
import time

_STAMP_NS = 35  # SO_TIMESTAMPNS, which the module socket does not name
_ROOM = 1 << 22
_LARGEST = 65_536
_FORM = struct.Struct("@qq")


def stamped(one: socket.socket) -> socket.socket:
    """The socket with much room for what waits, its datagrams stamped with the time where that can
    be had.
    """
    one.setblocking(False)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM)
    if sys.platform == "linux":
        one.setsockopt(socket.SOL_SOCKET, _STAMP_NS, 1)
    return one


def received(one: socket.socket) -> tuple[bytes, float] | None:
    """A datagram and its time of arrival on the clock of `time.perf_counter`; None where none is
    there.
    """
    try:
        if not hasattr(one, "recvmsg"):
            return one.recv(_LARGEST), time.perf_counter()
        packet, ancillary, _, _ = one.recvmsg(_LARGEST, 64)
    except OSError:  # nothing is there, or the word of a port where nobody listens
        return None
    return packet, _arrived(ancillary)


def _arrived(ancillary: list[tuple[int, int, bytes]]) -> float:
    now = time.perf_counter()
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _STAMP_NS and len(data) == _FORM.size:
            seconds, nanoseconds = _FORM.unpack(data)
            return now - max(0.0, time.time() - seconds - 1e-9 * nanoseconds)
    return now
