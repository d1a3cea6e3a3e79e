"""Ctrl-C: one line and exit code 130, whenever it comes."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType

STOPPED = 130


@dataclass
class Stop:
    """What Ctrl-C does: the end of the process before work has begun, then a KeyboardInterrupt,
    then the end again.

    An exception would not do before: whoever imports modules may take it for a module that is
    missing. ``left`` says what a stopped run has left.
    """

    left: Callable[[], str] = lambda: "nothing was written"
    begun: bool = False
    asked: bool = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """As a handler of signals."""
        if self.begun and not self.asked:
            self.asked = True
            raise KeyboardInterrupt
        with suppress(Exception):
            sys.stdout.flush()
        with suppress(OSError):
            os.write(2, f"{self.line}\n".encode(errors="backslashreplace"))
        os._exit(STOPPED)

    @property
    def line(self) -> str:
        """What is said then."""
        return f"habitus: stopped; {self.left()}"


@contextmanager
def on_ctrl_c(stop: Stop, stays: bool) -> Iterator[None]:
    """Let ``stop`` handle Ctrl-C, where it is not ignored or handled by somebody else; ``stays``:
    also afterwards.
    """
    try:
        mine = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        before = signal.signal(signal.SIGINT, stop) if mine else None
    except ValueError:  # another thread than the main one
        before = None
    try:
        yield
    finally:
        stop.begun = False
        if before is not None and not stays:
            signal.signal(signal.SIGINT, before)
