"""What every stream of markers offers, and the addresses it comes from."""

from collections import Counter
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, shown
from habitus.io.captures.points import RawPoints
from habitus.io.captures.read import FASTEST_HZ, SLOWEST_HZ
from habitus.io.names import plain_name

MAX_REASONS = 8
"""Reasons for skipped packets that are named; the text of a report stays short whatever arrives."""


def host_and_port(address: object, port: int) -> tuple[str, int]:
    """``HOST``, ``HOST:PORT`` or nothing, which is this machine; raises HabitusError for a port
    that is none.
    """
    text = "" if address is None else str(address).strip()
    host, colon, number = text.partition(":")
    if colon and not (number.isdigit() and 0 < int(number) < 65536):
        raise HabitusError(
            f"the address {shown(text)!r} has no port after its colon; expected HOST or HOST:PORT"
        )
    return host or "127.0.0.1", int(number) if colon else port


class Frame(NamedTuple):
    """One frame: its number, when it was there (`time.perf_counter`), and its points (N, 3), NaN
    where missing.

    Points are in the stream's own unit and axes. ``heading`` is a `RawPoints` without frames:
    labels, unit, axes, rate; another object from the frame on in which the stream says something
    else.
    """

    number: int
    arrived: float
    points: Float[np.ndarray, "N 3"]
    heading: RawPoints


class Skipped:
    """Packets that were received and not used, counted by reason."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, reason: str) -> None:
        """Count a packet; ``reason`` is a noun phrase in the plural, as in "truncated packets"."""
        if reason not in self._counts and len(self._counts) >= MAX_REASONS:
            reason = "other packets"
        self._counts[reason] += 1

    @property
    def total(self) -> int:
        """Number of packets."""
        return self._counts.total()

    def __str__(self) -> str:
        """The counts with their reasons; empty where nothing was skipped."""
        return ", ".join(f"{count} {reason}" for reason, count in self._counts.items())


class Source(Protocol):
    """Where frames come from.

    name: for messages. ended: no further frame will come. patient: it waits for whoever reads, so
    that no frame is ever late. skipped: packets that were received and not used.
    """

    name: str
    ended: bool
    patient: bool
    skipped: Skipped

    def poll(self, timeout: float) -> list[Frame]:
        """The frames that are there, waiting for the first of them for at most so many seconds.

        Raises HabitusError where the stream cannot go on.
        """
        ...

    def close(self) -> None:
        """Let go of sockets and threads; a second time it does nothing."""
        ...


def heading(
    kind: str,
    labels: tuple[str, ...],
    rate_hz: float | None,
    unit: str,
    up_claim: str | None,
    up_usual: str,
) -> RawPoints:
    """What a stream says of its points; ``kind`` names the protocol. A rate that no system has
    counts as unknown.
    """
    is_plausible = rate_hz is not None and SLOWEST_HZ <= rate_hz <= FASTEST_HZ
    return RawPoints(
        format=kind,
        labels=tuple(map(plain_name, labels)),
        points=np.zeros((0, len(labels), 3)),
        rate_hz=rate_hz if is_plausible else None,
        unit=unit,
        up_claim=up_claim,
        up_source=f"{kind} stream",
        up_usual=up_usual,
    )
