"""Says what is compiled when a command runs on this machine for the first time."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

NOTICE = "habitus: compiling kernels for this machine, once: about 30 s"


@contextmanager
def told_of_compilation(quiet: bool = False) -> Iterator[None]:
    """One line on stderr when a first kernel is compiled inside the block; later runs load kernels and say nothing."""
    if quiet:
        yield
        return
    from numba.core import event

    with event.install_listener("numba:compile", _once()):
        yield


def _once() -> object:
    from numba.core.event import Listener

    class Once(Listener):
        told = False

        def on_start(self, event: object) -> None:
            if not self.told:
                self.told = True
                print(NOTICE, file=sys.stderr, flush=True)

        def on_end(self, event: object) -> None:
            pass

    return Once()
