"""Who is told of a live fit's frames: a viewer in the browser, other programs by OSC and VMC."""

from collections.abc import Callable, Sequence

from habitus.errors import HabitusError, shown
from habitus.jobs.live import MakeSink


def sinks(send: Sequence[str], port: int | None, say: Callable[[str], None]) -> list[MakeSink]:
    """What ``--send`` and ``--view`` ask for; port: of the viewer's page, None for no viewer. Raises HabitusError."""
    del say
    if send or port is not None:
        raise HabitusError(f"not there yet: {shown(send)}")
    return []
