"""Reads markers live from OptiTrack's Motive over NatNet (UDP), multicast or unicast."""

import select
import socket
import struct
import sys
import time
from contextlib import suppress

import numpy as np

from habitus.errors import HabitusError
from habitus.io.streams import natnet_packets as natnet
from habitus.io.streams.source import Frame, heading, host_and_port

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


PORT = 1510
PATIENCE_S = 3.0
_TRY_S = 0.3
_ANSWER_S = 0.3
_ALIVE_S = 1.0
_UNITS = {1000: "m", 10: "cm", 1: "mm"}
_MOST = 1000
"""Packets that are taken at once."""


class NatNet:
    """Frames of a NatNet server. rate_hz: where it is not what the server says.

    Raises HabitusError where no server answers within `PATIENCE_S`, or an older one than NatNet 3.
    """

    patient = False

    def __init__(self, address: object = None, rate_hz: float | None = None):
        self._to = host_and_port(address, PORT)
        self.ended = False
        self.bad = 0
        self.name = f"natnet {self._to[0]}:{self._to[1]}"
        self._command = stamped(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self._sockets = [self._command]
        try:
            self._server = natnet.read_server(
                self._asked(natnet.connect_message(), natnet.SERVER_INFO)
            )
            if self._server.version < natnet.OLDEST:
                spoken = ".".join(map(str, self._server.version))
                raise HabitusError(
                    f"{self.name}: {self._server.name} speaks NatNet {spoken}; expected 3.0 or "
                    "later"
                )
            if self._server.group is not None:
                self._sockets.append(_joined(self._server.group, self._server.data_port, self._to))
            self._describe(rate_hz)
        except natnet.BadPacket as error:
            self.close()
            raise HabitusError(
                f"{self.name}: its answer is no NatNet ({error}); check the address"
            ) from None
        except BaseException:
            self.close()
            raise

    def poll(self, timeout: float) -> list[Frame]:
        """The frames that are there; the server is asked now and then to go on sending."""
        now = time.perf_counter()
        if self._server.group is None and now - self._alive > _ALIVE_S:
            self._alive = now
            self._send(natnet.message(natnet.KEEP_ALIVE))
        frames: list[Frame] = []
        ready = select.select(self._sockets, [], [], timeout)[0] if not self.ended else []
        for one in ready:
            frames += self._received(one)
        return frames

    def close(self) -> None:
        """Close the sockets."""
        self.ended = True
        for one in self._sockets:
            one.close()

    def _received(self, one: socket.socket) -> list[Frame]:
        """What is waiting at a socket."""
        frames: list[Frame] = []
        for _ in range(_MOST):
            found = received(one)
            if found is None:
                break
            try:
                frames += self._read(*found)
            except natnet.BadPacket:
                self.bad += 1
        return frames

    def _read(self, packet: bytes, at: float) -> list[Frame]:
        kind = natnet.kind_of(packet)
        if kind == natnet.MODEL:
            self._take_model(packet)
        if kind != natnet.FRAME:
            return []
        found = natnet.read_frame(packet, self._server.version, self._model)
        self._stale = self._stale or found.changed
        points = np.full_like(found.points, np.nan) if self._doubted(at) else found.points
        return [Frame(found.number, at, points, self._heading)]

    def _doubted(self, now: float) -> bool:
        """Whether another model definition is being waited for: until then nobody knows which
        marker is which.
        """
        if self._stale and now - self._asked_at > _ANSWER_S:
            self._asked_at = now
            self._stale = False
            self._waiting = True
            self._send(natnet.message(natnet.REQUEST_MODEL))
        return self._waiting and now - self._asked_at <= _ANSWER_S

    def _describe(self, rate_hz: float | None) -> None:
        """Ask for what frames do not tell: rate, unit, up axis, labels."""
        self._alive = -np.inf
        self._asked_at = -np.inf
        self._stale = False
        self._waiting = False
        rate, unit, up = (self._property(name, form) for name, form in _PROPERTIES)
        self._rate = rate_hz or (rate if rate and rate > 0 else None)
        self._model = natnet.Model((), {}, {})
        self._unit = _UNITS.get(round(unit or 1000), "m")
        self._up = None if up is None or up not in (0, 1, 2) else f"+{'xyz'[int(up)]}"
        self._take_model(self._asked(natnet.message(natnet.REQUEST_MODEL), natnet.MODEL))
        if not self._model.labels:
            raise HabitusError(
                f"{self.name}: {self._server.name} describes no markers; create a skeleton there, "
                "and stream "
                "labelled markers"
            )

    def _take_model(self, packet: bytes) -> None:
        """A model definition; what it changes is another heading."""
        model = natnet.read_model(packet, self._server.version)
        self._waiting = False
        if model != self._model:
            self._model = model
            self._heading = heading("natnet", model.labels, self._rate, self._unit, self._up, "+y")

    def _property(self, name: str, form: str) -> float | None:
        """The server's answer to a question, None where it has none."""
        with suppress(HabitusError):
            answer = self._asked(
                natnet.message(natnet.REQUEST, name.encode() + b"\0"), natnet.RESPONSE, _ANSWER_S
            )
            if len(answer) >= 8:
                return float(struct.unpack_from(form, answer, 4)[0])
        return None

    def _asked(self, question: bytes, kind: int, patience: float = PATIENCE_S) -> bytes:
        """The answer of a kind, asked for again and again. Raises HabitusError where none comes."""
        until = time.perf_counter() + patience
        while (left := until - time.perf_counter()) > 0:
            self._send(question)
            again = time.perf_counter() + min(_TRY_S, left)
            while (wait := again - time.perf_counter()) > 0:
                if not select.select([self._command], [], [], wait)[0]:
                    break
                packet, _ = received(self._command) or (b"", 0.0)
                with suppress(natnet.BadPacket):
                    found = natnet.kind_of(packet)
                    if found == kind:
                        return packet
                    if found == natnet.UNRECOGNISED:
                        until = 0.0
        raise HabitusError(
            f"{self.name}: no answer within {patience:g} s; is Motive running there, does it "
            "stream, "
            "and does no firewall block it?"
        )

    def _send(self, packet: bytes) -> None:
        try:
            self._command.sendto(packet, self._to)
        except OSError as error:
            why = error.strerror or error
            raise HabitusError(
                f"{self.name}: cannot be reached ({why}); check the address"
            ) from None


_PROPERTIES = (("FrameRate", "<f"), ("UnitsToMillimeters", "<f"), ("UpAxis", "<i"))


def _joined(group: str, port: int, server: tuple[str, int]) -> socket.socket:
    """A socket that hears a multicast group, on the way to the server. Raises HabitusError."""
    data = stamped(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way:
            way.connect(server)
            local = way.getsockname()[0]
        data.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        data.bind(("", port))
        data.setsockopt(
            socket.IPPROTO_IP,
            socket.IP_ADD_MEMBERSHIP,
            socket.inet_aton(group) + socket.inet_aton(local),
        )
    except OSError as error:
        data.close()
        raise HabitusError(
            f"natnet: the multicast group {group}:{port} cannot be joined "
            f"({error.strerror or error}); choose unicast"
        ) from None
    return data
