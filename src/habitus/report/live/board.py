"""What a live fit shows, in memory that it shares with the viewer's process: the latest frame
alone, nobody waits.
"""

from multiprocessing.context import SpawnContext
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

_TEXT = 1024
_TRIES = 20


class Shown(NamedTuple):
    """A frame: pose (J, 3) rad, trans (3,) m, markers (N, 3) m, their distances from the body (N,)
    m, and a text.

    ``text`` is Markdown. NaN where nobody, or a marker, is not seen.
    """

    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    markers: Float[np.ndarray, "N 3"]
    distances: Float[np.ndarray, " N"]
    text: str


class Board:
    """The latest frame, for one who writes and one who reads in another process, and words between
    them.

    A number counts what is written, odd while something is: who reads takes what has the same even
    number before and after. ``port`` is the viewer's, 0 until it serves; ``stop`` asks it to end.
    """

    def __init__(self, context: SpawnContext, joints: int, markers: int):
        self.joints = joints
        self.markers = markers
        self._count = context.RawArray("q", 3)
        self._numbers = context.RawArray("d", 3 * joints + 3 + 4 * markers)
        self._text: Any = context.RawArray("c", _TEXT)

    @property
    def port(self) -> int:
        """Of the viewer's page."""
        return self._count[1]

    @port.setter
    def port(self, port: int) -> None:
        self._count[1] = port

    @property
    def stop(self) -> bool:
        """Whether the viewer shall end."""
        return bool(self._count[2])

    @stop.setter
    def stop(self, stop: bool) -> None:
        self._count[2] = stop

    @property
    def count(self) -> int:
        """How many frames were shown."""
        return self._count[0] // 2

    def write(self, shown: Shown) -> None:
        """Show a frame; some microseconds."""
        self._count[0] += 1
        np.frombuffer(self._numbers)[:] = np.concatenate([np.ravel(part) for part in shown[:4]])
        self._text.value = shown.text.encode()[: _TEXT - 1]
        self._count[0] += 1

    def read(self) -> Shown | None:
        """The latest frame, None before there is one, or where every look at it was disturbed."""
        for _ in range(_TRIES):
            before = self._count[0]
            numbers = np.frombuffer(self._numbers).copy()
            text = self._text.value
            if before and before % 2 == 0 and self._count[0] == before:
                ends = np.cumsum([3 * self.joints, 3, 3 * self.markers])
                pose, trans, markers, distances = np.split(numbers, ends)
                return Shown(
                    pose.reshape(-1, 3),
                    trans,
                    markers.reshape(-1, 3),
                    distances,
                    text.decode("utf-8", "ignore"),
                )
        return None
