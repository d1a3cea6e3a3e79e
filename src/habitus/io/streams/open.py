"""The source that a name and an address ask for."""

from habitus.errors import HabitusError
from habitus.io.streams.replay import Replay
from habitus.io.streams.source import Source
from habitus.types import PathLike

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
