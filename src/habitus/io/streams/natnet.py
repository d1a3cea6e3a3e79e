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
from habitus.io.streams.source import Frame, Skipped, heading, host_and_port

PORT = 1510
PATIENCE_S = 3.0
"""Until a server must have answered."""
_RETRY_S = 0.3
_ANSWER_S = 0.3
_ALIVE_S = 1.0
_UNITS = {1000: "m", 10: "cm", 1: "mm"}
_MAX_AT_ONCE = 1000
"""Packets that are read from a socket in one go."""
_BUFFER_BYTES = 1 << 22
_MAX_DATAGRAM = 65_536
_SO_TIMESTAMPNS = 35  # which the module socket does not name
_TIMESPEC = struct.Struct("@qq")


def stamped(udp: socket.socket) -> socket.socket:
    """The socket with a large buffer, its datagrams stamped with the time where that can be had."""
    udp.setblocking(False)
    udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    if sys.platform == "linux":
        udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    return udp


def received(udp: socket.socket) -> tuple[bytes, float, str] | None:
    """A datagram, its time of arrival on the clock of `time.perf_counter`, and the sender's host;
    None where none is there.
    """
    try:
        if not hasattr(udp, "recvmsg"):
            packet, sender = udp.recvfrom(_MAX_DATAGRAM)
            return packet, time.perf_counter(), sender[0]
        packet, ancillary, _, sender = udp.recvmsg(_MAX_DATAGRAM, 64)
    except OSError:  # nothing is there, or the word of a port where nobody listens
        return None
    return packet, _arrival(ancillary), sender[0]


def _arrival(ancillary: list[tuple[int, int, bytes]]) -> float:
    now = time.perf_counter()
    for level, kind, data in ancillary:
        is_stamp = level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS
        if is_stamp and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return now - max(0.0, time.time() - seconds - 1e-9 * nanoseconds)
    return now


class NatNet:
    """Frames of a NatNet server. rate_hz: where it is not what the server says.

    Packets count where they come from the host that was asked; others, and those that cannot be
    read, are counted in ``skipped``. UDP does not prove a sender: who can forge addresses on the
    network can send frames. Raises HabitusError where no server answers within `PATIENCE_S`, or an
    older one than NatNet 3.
    """

    patient = False

    def __init__(self, address: object = None, rate_hz: float | None = None):
        host, port = host_and_port(address, PORT)
        self.ended = False
        self.skipped = Skipped()
        self.name = f"natnet {host}:{port}"
        self._to = (self._resolved(host), port)
        self._trusted: dict[str, bool] = {self._to[0]: True}
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
            self._try_send(natnet.message(natnet.KEEP_ALIVE))
        frames: list[Frame] = []
        ready = select.select(self._sockets, [], [], timeout)[0] if not self.ended else []
        for udp in ready:
            frames += self._received(udp)
        return frames

    def close(self) -> None:
        """Close the sockets."""
        self.ended = True
        for udp in self._sockets:
            udp.close()

    def _resolved(self, host: str) -> str:
        """The address of a host, in numbers. Raises HabitusError."""
        try:
            return socket.gethostbyname(host)
        except (OSError, UnicodeError) as error:
            raise self._unreachable(error) from None

    def _unreachable(self, error: Exception) -> HabitusError:
        why = getattr(error, "strerror", None) or error
        return HabitusError(f"{self.name}: cannot be reached ({why}); check the address")

    def _is_server(self, host: str) -> bool:
        """Whether a packet's sender is the server; counts the packet where it is not.

        A server on this machine that is asked at 127.0.0.1 may send by another of the machine's
        addresses: multicast goes out by the network.
        """
        if host not in self._trusted and len(self._trusted) < _MAX_SENDERS:
            self._trusted[host] = self._to[0] == "127.0.0.1" and _is_this_machine(host)
        is_server = self._trusted.get(host, False)
        if not is_server:
            self.skipped.add(f"packets from {host}, which is not the server")
        return is_server

    def _received(self, udp: socket.socket) -> list[Frame]:
        """What is waiting at a socket."""
        frames: list[Frame] = []
        for _ in range(_MAX_AT_ONCE):
            packets = received(udp)
            if packets is None:
                break
            packet, arrived, sender = packets
            if not self._is_server(sender):
                continue
            try:
                frames += self._read(packet, arrived)
            except natnet.BadPacket as error:
                self.skipped.add(str(error))
        return frames

    def _read(self, packet: bytes, at: float) -> list[Frame]:
        kind = natnet.kind_of(packet)
        if kind == natnet.MODEL:
            self._take_model(packet)
        if kind != natnet.FRAME:
            return []
        frames = natnet.read_frame(packet, self._server.version, self._model)
        self._stale = self._stale or frames.changed
        points = np.full_like(frames.points, np.nan) if self._doubted(at) else frames.points
        return [Frame(frames.number, at, points, self._heading)]

    def _doubted(self, now: float) -> bool:
        """Whether another model definition is being waited for: until then nobody knows which
        marker is which.
        """
        if self._stale and now - self._asked_at > _ANSWER_S:
            self._asked_at = now
            self._stale = False
            self._waiting = True
            self._try_send(natnet.message(natnet.REQUEST_MODEL))
        return self._waiting and now - self._asked_at <= _ANSWER_S

    def _describe(self, rate_hz: float | None) -> None:
        """Ask for what frames do not tell: rate, unit, up axis, labels."""
        self._alive = -np.inf
        self._asked_at = -np.inf
        self._stale = False
        self._waiting = False
        rate, unit, up = (self._property(name, form) for name, form in _PROPERTIES)
        self._rate = rate_hz or rate
        self._model = natnet.Model((), {}, {})
        self._unit = _UNITS.get(round(unit), "m") if unit and np.isfinite(unit) else "m"
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
            again = time.perf_counter() + min(_RETRY_S, left)
            while (wait := again - time.perf_counter()) > 0:
                if not select.select([self._command], [], [], wait)[0]:
                    break
                packet, _, sender = received(self._command) or (b"", 0.0, "")
                if not sender or not self._is_server(sender):
                    continue
                try:
                    reply = natnet.kind_of(packet)
                except natnet.BadPacket as error:
                    self.skipped.add(str(error))
                    continue
                if reply == kind:
                    return packet
                if reply == natnet.UNRECOGNISED:
                    until = 0.0
        others = f"; received {self.skipped}" if self.skipped.total else ""
        raise HabitusError(
            f"{self.name}: no answer within {patience:g} s; is Motive running there, does it "
            f"stream, and does no firewall block it?{others}"
        )

    def _send(self, packet: bytes) -> None:
        try:
            self._command.sendto(packet, self._to)
        except OSError as error:
            raise self._unreachable(error) from None

    def _try_send(self, packet: bytes) -> None:
        """Send while frames come: a network that is gone for a moment does not end the stream."""
        with suppress(OSError):
            self._command.sendto(packet, self._to)


_PROPERTIES = (("FrameRate", "<f"), ("UnitsToMillimeters", "<f"), ("UpAxis", "<i"))


_MAX_SENDERS = 1000
"""Senders that are remembered; further ones are strangers."""


def _is_this_machine(host: str) -> bool:
    """Whether an address outside the loopback network is one of this machine's own."""
    if host.startswith("127."):
        return False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, 0))
        except OSError:
            return False
    return True


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
