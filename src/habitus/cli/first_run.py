"""Says what is compiled when a command runs on this machine for the first time."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

NOTICE = "habitus: compiling kernels for this machine, once: about 15 s"


@contextmanager
def told_of_compilation(quiet: bool = False) -> Iterator[None]:
    """One line on stderr when a first kernel is compiled inside the block; later runs load kernels
    and say nothing.
    """
    if quiet:
        yield
        return
    from numba.core import event

    with event.install_listener("numba:compile", _once(sys.stderr)):
        yield


def _once(stream: TextIO) -> object:
    """Tells `stream`; on a terminal what stands in its place by then, so that a progress bar stays
    whole.
    """
    from numba.core.event import Listener

    class Once(Listener):
        told = False

        def on_start(self, event: object) -> None:
            if not self.told:
                self.told = True
                print(NOTICE, file=sys.stderr if stream.isatty() else stream, flush=True)

        def on_end(self, event: object) -> None:
            pass

    return Once()
