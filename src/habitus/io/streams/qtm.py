"""Qualisys Track Manager over its real-time protocol, by Qualisys' own package qtm-rt."""

import asyncio
import queue
import struct
import threading
import time
from collections.abc import Callable, Collection
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from habitus.errors import HabitusError, require_extra
from habitus.io.captures.points import RawPoints
from habitus.io.limits import MAX_NAMES, MAX_TEXT_BYTES, read_xml
from habitus.io.streams.source import Frame, Skipped, heading, host_and_port
from habitus.rotations import signed_axis

PORT = 22223
PATIENCE_S = 5.0
_VERSION = "1.20"
_HEADER = struct.Struct("<II")
_MAX_PACKET = 1 << 24
"""Bytes of a packet: a thousand times what a frame of markers takes."""
_COMPONENT_BYTES = 8
_FRAME_BYTES = 16
_SETTINGS_CHANGED = "EventCameraSettingsChanged"
_ENDS = "EventQTMShuttingDown"


class Qtm:
    """Frames of a Qualisys Track Manager. rate_hz: where it is not what the program says.

    It is one TCP connection: nobody but the program that was asked can send. Packets that cannot be
    read are counted in ``skipped``. Raises HabitusError where qtm-rt is not installed, nobody
    answers within `PATIENCE_S`, or no labelled markers are described.
    """

    patient = False

    def __init__(self, address: object = None, rate_hz: float | None = None):
        self._qtm = require_extra("qtm_rt", "QTM streams", "live")
        self._host, self._port = host_and_port(address, PORT)
        self.name = f"qtm {self._host}:{self._port}"
        self.ended = False
        self.skipped = Skipped()
        self._rate = rate_hz
        self._frames = queue.SimpleQueue[Frame]()
        self._heading: RawPoints | None = None
        self._asking: asyncio.Task[None] | None = None
        self._loop = asyncio.new_event_loop()
        self._connection = None
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._done(self._begin(), 2 * PATIENCE_S)
        except BaseException:
            self.close()
            raise

    def poll(self, timeout: float) -> list[Frame]:
        """The frames that are there."""
        frames: list[Frame] = []
        try:
            frames.append(
                self._frames.get(timeout=timeout) if timeout > 0 else self._frames.get_nowait()
            )
            while True:
                frames.append(self._frames.get_nowait())
        except queue.Empty:
            return frames

    def close(self) -> None:
        """Disconnect, and end the thread that receives."""
        self.ended = True
        if self._loop.is_closed():
            return
        if self._connection is not None and self._connection.has_transport():
            self._loop.call_soon_threadsafe(self._connection.disconnect)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(1.0)
        if not self._thread.is_alive():
            self._loop.close()

    def _done(self, work: Any, patience: float) -> Any:
        """The result of some asynchronous work. Raises HabitusError where it takes too long or the
        program refuses.
        """
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(patience)
        except HabitusError:
            raise
        except TimeoutError:
            future.cancel()
            raise HabitusError(
                f"{self.name}: no answer within {patience:g} s; is QTM's real-time output on?"
            ) from None
        except Exception as error:  # qtm-rt's own, and asyncio's
            raise HabitusError(f"{self.name}: {error}; check QTM's real-time output") from None

    async def _begin(self) -> None:
        protocol = _checked_protocol(self._skip)(
            loop=self._loop, on_event=self._on_event, on_disconnect=self._on_end
        )
        connect = self._loop.create_connection(lambda: protocol, self._host, self._port)
        try:
            await asyncio.wait_for(connect, PATIENCE_S)
        except OSError:
            raise HabitusError(
                f"{self.name}: no answer; is QTM running there, its real-time output on, and "
                "no firewall between?"
            ) from None
        self._connection = self._qtm.QRTConnection(protocol, timeout=PATIENCE_S)
        await asyncio.wait_for(protocol.set_version(_VERSION), PATIENCE_S)
        await self._describe()
        if self._heading is None or not self._heading.labels:
            raise HabitusError(
                f"{self.name}: no labelled markers are streamed; apply an AIM model and open a "
                "measurement"
            )
        await self._connection.stream_frames(components=["3d"], on_packet=self._on_packet)

    async def _describe(self) -> None:
        """Ask for labels, rate and up axis; what they change is another heading."""
        assert self._connection is not None
        found = _parameters(
            await self._connection.get_parameters(["general", "3d"]), self._rate, self.name
        )
        if self._heading is None or (found.labels, found.rate_hz) != (
            self._heading.labels,
            self._heading.rate_hz,
        ):
            self._heading = found

    def _on_packet(self, packet: Any) -> None:
        """A frame; the package calls it in its own thread."""
        arrived = time.perf_counter()
        head = self._heading
        try:
            _, markers = packet.get_3d_markers()
            points = np.array(markers, dtype=np.float64).reshape(-1, 3)
        except (TypeError, ValueError, struct.error):  # without markers, or truncated
            self._skip("packets without readable markers")
            return
        points[~np.isfinite(points).all(axis=1)] = np.nan
        if head is None or len(points) != len(head.labels):
            self._describe_again()
            return
        self._frames.put(Frame(packet.framenumber, arrived, points, head))

    def _on_event(self, event: Any) -> None:
        if event.name == _SETTINGS_CHANGED and self._heading is not None:
            self._describe_again()
        elif event.name == _ENDS:
            self.ended = True

    def _describe_again(self) -> None:
        """Labels are another's: frames are left out until they are known."""
        if self._asking is None or self._asking.done():
            self._asking = self._loop.create_task(self._describe())
            self._asking.add_done_callback(self._described)

    def _described(self, done: "asyncio.Task[None]") -> None:
        if not done.cancelled() and done.exception() is not None:
            self._skip("unreadable descriptions of the markers")

    def _skip(self, reason: str) -> None:
        self.skipped.add(reason)

    def _on_end(self, error: object) -> None:
        self.ended = True


def _is_frame(payload: bytes, components: Collection[int]) -> bool:
    """Whether a frame holds the number of components that it claims, of these types, one after
    another.
    """
    if len(payload) < _FRAME_BYTES:
        return False
    _, _, count = struct.unpack_from("<qII", payload)
    at = _FRAME_BYTES
    for _ in range(count):
        if at + _COMPONENT_BYTES > len(payload):
            return False
        size, kind = _HEADER.unpack_from(payload, at)
        if kind not in components or size < _COMPONENT_BYTES or at + size > len(payload):
            return False
        at += size
    return True


def _checked_protocol(skip: Callable[[str], None]) -> Any:
    """qtm-rt's protocol, given sound packets only; others are handed to ``skip``, with a reason.

    The package trusts sizes and numbers: a packet of an unknown type closes its connection, and one
    of no size is read for ever.
    """
    from qtm_rt.packet import QRTComponentType, QRTEvent, QRTPacketType
    from qtm_rt.protocol import QTMProtocol

    handled = {kind.value for kind in QRTPacketType} - {
        QRTPacketType.PacketC3DFile.value,
        QRTPacketType.PacketDiscover.value,
        QRTPacketType.PacketQTMFile.value,
        QRTPacketType.PacketNone.value,
    }
    events = {event.value for event in QRTEvent}
    components = {kind.value for kind in QRTComponentType}

    def fault(kind: int, payload: bytes) -> str | None:
        if kind not in handled:
            return "packets of an unknown type"
        if kind == QRTPacketType.PacketEvent.value:
            known = len(payload) == 1 and payload[0] in events
            return None if known else "unknown events"
        if kind == QRTPacketType.PacketData.value and not _is_frame(payload, components):
            return "truncated packets"
        return None

    class Checked(QTMProtocol):
        """The package's protocol behind the checks."""

        def __init__(self, **options: Any):
            super().__init__(**options)
            self._arrived = b""

        def data_received(self, data: bytes) -> None:
            """Hand on whole and sound packets."""
            self._arrived += data
            while len(self._arrived) >= _HEADER.size:
                size, kind = _HEADER.unpack_from(self._arrived)
                if not _HEADER.size <= size <= _MAX_PACKET:
                    # where the next packet begins cannot be known: usually with what comes next
                    skip("packets of an impossible size")
                    self._arrived = b""
                    return
                if len(self._arrived) < size:
                    return
                packet = self._arrived[:size]
                self._arrived = self._arrived[size:]
                reason = fault(kind, packet[_HEADER.size :])
                if reason is None:
                    super().data_received(packet)
                else:
                    skip(reason)

    return Checked


def _parameters(parameters: bytes, rate_hz: float | None, name: str) -> RawPoints:
    """What QTM's parameters say of its markers. Raises HabitusError."""
    try:
        root = read_xml(parameters.decode("utf-8", "replace"), MAX_TEXT_BYTES)
    except HabitusError as error:
        raise HabitusError(f"{name}: its parameters are not XML ({error})") from None
    labels = tuple(
        (label.findtext("Name") or "").strip() for label in root.iterfind(".//The_3D/Label")
    )
    if len(labels) > MAX_NAMES:
        raise HabitusError(f"{name}: {len(labels)} labels; expected at most {MAX_NAMES}")
    claim = signed_axis(root.findtext(".//The_3D/AxisUpwards"))
    return heading(
        "qtm", labels, rate_hz or _number(root, ".//General/Frequency"), "mm", claim, "+z"
    )


def _number(root: Element, path: str) -> float | None:
    try:
        return float(root.findtext(path) or "") or None
    except ValueError:
        return None
