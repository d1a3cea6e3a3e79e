"""Reads 2D keypoints live from detectors, over UDP: a JSON object for each camera and frame,

    {"camera": "cam1", "frame": 17, "convention": "halpe26", "keypoints": [[x, y, score], ...]}

one a datagram, or several as lines of one. ``frame`` is a number that all cameras share, or
``time`` takes its place: seconds of a clock that they share. ``keypoints`` holds one person, []
for nobody; ``people`` in its place holds several such lists. Pixels are those of the image, its
first pixel's centre at 0, as detectors count; scores are 0 to 1. The first datagram's convention,
one of `habitus.body.keypoints.CONVENTIONS`, is that of the stream.
"""

import select
import socket
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError
from habitus.io.captures.points import RawPoints
from habitus.io.keypoints.archives import MAX_PIXEL
from habitus.io.limits import read_json
from habitus.io.streams.natnet import received, stamped
from habitus.io.streams.source import Frame, Skipped, heading, host_and_port
from habitus.observe.detections import plain_camera_name

PORT = 5005
MAX_PEOPLE = 8
"""Of one camera, in one frame; further ones are left out."""
MAX_LINE = 1 << 16
MAX_LINES = 256
"""Of one datagram."""
MAX_KEYPOINTS = 500
"""Of one person in a datagram: whole-body detectors have faces and hands."""
MAX_NUMBER = 1 << 53
AT_ONCE = 1000
PATIENCE_S = 0.05
"""A frame waits so long for cameras that are late,"""
SILENT_S = 1.0
"""but not for those that were not heard for so long."""
BEHIND, AHEAD = 100, 1000
"""Frames that a number may be behind and ahead of the last one; others count once the next one
agrees."""

People = Float[np.ndarray, "n K 3"]


class Seen(NamedTuple):
    """A line: a camera's people (n, K, 3; pixels with their centres at halves, confidence) in a
    frame of this number, or at this time (s).
    """

    camera: str
    convention: str
    number: int | None
    seconds: float | None
    people: People


class DetectionStream:
    """Frames of detectors. ``cameras``: names as in the calibration; rate_hz: where detectors give
    times instead of numbers, or not the rate at which frames come.

    A frame's points (C P K, 3) are x, y (px) and confidence of each camera, person (`MAX_PEOPLE`)
    and keypoint; the heading's format is the convention. A frame is there once all cameras sent it,
    or those that are heard for `PATIENCE_S`. address: the interface that is listened on, HOST or
    HOST:PORT; by itself this machine's loopback, 0.0.0.0 for all. Whatever cannot be used is
    counted in ``skipped``. UDP does not prove a sender. Raises HabitusError where nothing can be
    listened to there.
    """

    patient = False

    def __init__(
        self, cameras: Sequence[str], address: object = None, rate_hz: float | None = None
    ):
        host, port = host_and_port(address, PORT)
        self.name = f"detections {host}:{port}"
        self.ended = False
        self.skipped = Skipped()
        self.cameras = tuple(cameras)
        self.convention = ""
        self._rate = rate_hz
        self._row = {plain_camera_name(name): k for k, name in enumerate(cameras)}
        self._heading: RawPoints | None = None
        self._waiting: dict[int, dict[int, People]] = {}
        self._arrived: dict[int, float] = {}
        self._heard = np.full(len(cameras), -np.inf)
        self._last: int | None = None
        self._newest: int | None = None
        self._jump: int | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            stamped(self._socket).bind((host, port))
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise HabitusError(
                f"{self.name}: cannot listen there ({getattr(error, 'strerror', error)}); give "
                "another address or close what listens"
            ) from None

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    def poll(self, timeout: float) -> list[Frame]:
        """The frames that are there, waiting for the first of them for at most so many seconds."""
        until = time.perf_counter() + timeout
        while not self.ended:
            self._receive(max(0.0, self._next_at(until) - time.perf_counter()))
            if (frames := self._due()) or time.perf_counter() >= until:
                return frames
        return []

    def close(self) -> None:
        """Close the socket."""
        self.ended = True
        self._socket.close()

    def _next_at(self, until: float) -> float:
        """When there is something to do, at the latest."""
        return min(until, min(self._arrived.values(), default=until) + PATIENCE_S)

    def _receive(self, timeout: float) -> None:
        if not select.select([self._socket], [], [], timeout)[0]:
            return
        for _ in range(AT_ONCE):
            packet = received(self._socket)
            if packet is None:
                return
            self.take(packet[0], packet[1])

    def take(self, packet: bytes, arrived: float) -> None:
        """Take in a datagram that was there at a time (`time.perf_counter`)."""
        lines = packet.splitlines()
        if len(lines) > MAX_LINES:
            self.skipped.add("datagrams of too many lines")
            return
        for line in lines:
            if not line.strip():
                continue
            try:
                self._add(read_line(line), arrived)
            except ValueError as error:
                self.skipped.add(str(error))

    def _add(self, seen: Seen, arrived: float) -> None:
        """Raises ValueError, a noun phrase in the plural, where a line is not used."""
        camera = self._row.get(plain_camera_name(seen.camera))
        if camera is None:
            raise ValueError("lines of cameras without calibration")
        if self._heading is None:
            self._begin(seen.convention)
            self._heard[:] = arrived  # the others may follow
        if seen.convention != self.convention:
            raise ValueError("lines of another convention")
        number = self._number(seen)
        self._heard[camera] = arrived
        if self._last is not None and number <= self._last:
            raise ValueError("lines too late")
        self._arrived.setdefault(number, arrived)
        self._waiting.setdefault(number, {})[camera] = seen.people

    def _begin(self, convention: str) -> None:
        names = CONVENTIONS[convention]
        labels = tuple(
            f"{camera}:{person}:{name}"
            for camera in self.cameras
            for person in range(MAX_PEOPLE)
            for name in names
        )
        self.convention = convention
        self._heading = heading(convention, labels, self._rate, "px", None, "+y")

    def _number(self, seen: Seen) -> int:
        """A line's number. One far from the others counts where the line before it said alike: a
        sender begins anew.
        """
        if seen.number is not None:
            number = seen.number
        elif seen.seconds is not None and self._rate:
            number = round(seen.seconds * self._rate)
        else:
            raise ValueError("lines with a time, for which the rate is missing (--fps HZ)")
        if abs(number) > MAX_NUMBER:
            raise ValueError("lines with numbers that no frame has")
        newest = number if self._newest is None else self._newest
        if not -BEHIND <= number - newest <= AHEAD:
            agreed = self._jump is not None and abs(number - self._jump) <= BEHIND
            self._jump = number
            if not agreed:
                raise ValueError("lines with numbers far from the others")
            self._waiting.clear()
            self._arrived.clear()
            self._last = None
            newest = number
        self._newest = max(newest, number)
        return number

    def _due(self) -> list[Frame]:
        """The frames that are complete, or waited long enough, and those before them."""
        now = time.perf_counter()
        awaited = set(np.flatnonzero(now - self._heard < SILENT_S).tolist())
        due = [
            number
            for number, own in self._waiting.items()
            if awaited <= own.keys() or now - self._arrived[number] > PATIENCE_S
        ]
        if not due:
            return []
        ready = sorted(number for number in self._waiting if number <= max(due))
        self._last = ready[-1]
        return [self._frame(number) for number in ready]

    def _frame(self, number: int) -> Frame:
        assert self._heading is not None
        count = len(CONVENTIONS[self.convention])
        points = np.full((len(self.cameras), MAX_PEOPLE, count, 3), np.nan)
        for camera, people in self._waiting.pop(number).items():
            points[camera, : len(people)] = people
        return Frame(number, self._arrived.pop(number), points.reshape(-1, 3), self._heading)


def read_line(line: bytes) -> Seen:
    """What a line says. Raises ValueError, a noun phrase in the plural, where it cannot be used."""
    try:
        table = read_json(line.decode("utf-8"), MAX_LINE)
    except (HabitusError, UnicodeDecodeError):
        raise ValueError("lines that are no JSON") from None
    if not isinstance(table, Mapping):
        raise ValueError("lines that are no JSON object")
    camera, convention = table.get("camera"), table.get("convention")
    if not isinstance(camera, str) or not 0 < len(camera) < 200:
        raise ValueError("lines without a camera")
    if not isinstance(convention, str) or convention not in CONVENTIONS:
        raise ValueError("lines without a known convention")
    number, seconds = table.get("frame"), table.get("time")
    if not _is_number(number):
        number = None
    if not _is_number(seconds):
        seconds = None
    if number is None and seconds is None:
        raise ValueError("lines without a frame or a time")
    given = table["people"] if "people" in table else [table.get("keypoints")]
    if not isinstance(given, list):
        raise ValueError("lines without keypoints")
    count = len(CONVENTIONS[convention])
    there = [one for one in given if one != []]
    people = [_person(one, count) for one in there[:MAX_PEOPLE]]
    rows = np.stack(people) if people else np.zeros((0, count, 3))
    return Seen(
        camera,
        convention,
        None if number is None else int(number),
        None if seconds is None else float(seconds),
        rows,
    )


def _is_number(value: Any) -> bool:
    """A finite number, of a size that a float holds."""
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and abs(value) < 1e15  # NaN compares false
    )


def _person(given: Any, count: int) -> Float[np.ndarray, "K 3"]:
    """The first ``count`` keypoints, NaN where missing."""
    if not isinstance(given, list) or not count <= len(given) <= MAX_KEYPOINTS:
        raise ValueError("lines without the keypoints of their convention")
    try:
        row = np.array(given[:count], float)
    except (ValueError, TypeError, OverflowError):
        raise ValueError("lines without the keypoints of their convention") from None
    if row.shape != (count, 3):
        raise ValueError("lines without the keypoints of their convention")
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(row).all(1) & (row[:, 2] > 0.0)
        seen &= (np.abs(row[:, :2]) < MAX_PIXEL).all(1)
    row[:, :2] += 0.5
    row[:, 2] = np.minimum(row[:, 2], 1.0)
    row[~seen] = np.nan
    return row
