"""Opens a stream by its name: natnet, qtm, or a capture replayed at its own rate."""

import time
from dataclasses import replace
from pathlib import Path

from habitus.errors import HabitusError
from habitus.io.captures.read import read_raw
from habitus.io.captures.trajectories import hide_placeholders
from habitus.io.streams.source import Frame, Skipped, Source
from habitus.types import PathLike


class Replay:
    """The frames of a capture file, at its own rate or another.

    rate_hz: how many frames a second are played, None for the file's rate, 0 for as many as are
    asked for. Raises HabitusError where the file cannot be read.
    """

    def __init__(self, path: PathLike, rate_hz: float | None = None):
        path = Path(path)
        raw, rate = read_raw(path)
        self.name = path.name
        self.ended = False
        self.skipped = Skipped()
        self.patient = rate_hz == 0
        self._points = hide_placeholders(raw.points)
        self._heading = replace(raw, points=raw.points[:0], rate_hz=rate)
        self._pace = rate if rate_hz is None else rate_hz
        self._next = 0
        self._began = 0.0

    def poll(self, timeout: float) -> list[Frame]:
        """The frames that are due by now; of a patient source one."""
        if self.ended:
            return []
        now = time.perf_counter()
        if self.patient:
            return self._taken(self._next + 1, now)
        if not self._next and not self._began:
            self._began = now
        wait = self._began + self._next / self._pace - now
        if wait > 0:
            time.sleep(min(wait, timeout))
            now = time.perf_counter()
        return self._taken(int((now - self._began) * self._pace) + 1, now)

    def close(self) -> None:
        """Nothing is open."""
        self.ended = True

    def _taken(self, until: int, now: float) -> list[Frame]:
        first = self._next
        until = min(until, len(self._points))
        self._next = max(first, until)
        self.ended = self._next == len(self._points)
        due = [now if self.patient else self._began + k / self._pace for k in range(first, until)]
        return [
            Frame(k, at, self._points[k], self._heading)
            for k, at in zip(range(first, until), due, strict=True)
        ]


SOURCES = ("replay", "natnet", "qtm")


def open_source(kind: str, address: PathLike | None, rate_hz: float | None) -> Source:
    """A source that is listened to from now on.

    kind: one of `SOURCES`. address: a file for "replay", else a host with or without ``:port``.
    rate_hz: how fast a file is played. Raises HabitusError where nothing is there, in time or at
    all.
    """
    if kind not in SOURCES:
        raise HabitusError(f"there is no source {kind!r}; expected one of {', '.join(SOURCES)}")
    if kind == "replay":
        if address is None:
            raise HabitusError(
                "replay: no capture was given; expected a file (C3D, TRC, CSV, TSV or npz)"
            )
        return Replay(address, rate_hz)
    if kind == "natnet":
        from habitus.io.streams.natnet import NatNet

        return NatNet(address, rate_hz)
    from habitus.io.streams.qtm import Qtm

    return Qtm(address, rate_hz)
