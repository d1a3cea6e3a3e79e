"""What is kept and told while a body is learned."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from habitus.jobs.checkpoints import Checkpoint
from habitus.learn.steps.alternation import STEPS
from habitus.learn.train import Progress, Record
from habitus.parallel.workers import Item, Result, Workers


@dataclass(frozen=True)
class Counted:
    """Workers, and somebody who is told how many of a call's items are done."""

    workers: Workers
    counted: Callable[[int, int], None]

    def map(self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]) -> Iterator[Result]:
        """The workers' results."""
        for done, result in enumerate(self.workers.map(function, shared, items), 1):
            self.counted(done, len(items))
            yield result


class Watch:
    """Keeps checkpoints of a training, its seconds of work over all runs, and tells how far it is.

    Stages are "poses by edges", "rounds" (of which there are ``rounds`` at most), "shapes" and, where pose blend shapes
    depend on shape, "rounds by shape"; ``title`` stands before them. ``progress`` is where an earlier run came to, or
    None.
    """

    def __init__(
        self,
        title: str,
        checkpoint: Checkpoint,
        rounds: int,
        tell: Callable[[str, float], None],
        told: Callable[[str, Record], None],
    ):
        self.title, self.checkpoint, self.tell, self.told = title, checkpoint, tell, told
        self.progress, self.seconds = checkpoint.load()
        self._all = rounds * len(STEPS)
        self._steps = len(STEPS) * self.progress.rounds if self.progress else -1  # done; -1: not begun
        self._ended = self._steps if self.progress and self.progress.finished else None  # steps of the first rounds
        self._share, self._people, self._there = 0.0, 0, 0
        self._earlier = max([0.0, *self.seconds[-1:], checkpoint.seconds])
        self._began = time.perf_counter()

    @property
    def elapsed(self) -> float:
        """Seconds of work so far, those of earlier runs included."""
        return self._earlier + time.perf_counter() - self._began

    def counted(self, done: int, total: int) -> None:
        """So many items of a call to the workers are done: part of a step."""
        if self._there < self._people:
            return
        if self._steps < 0:
            self.tell(f"{self.title}: poses by edges", done / total)
            return
        step = (self._steps - (self._ended or 0) + done / total) / self._all
        self._share = min(1.0, max(self._share, step))
        self.tell(f"{self.title}: rounds{'' if self._ended is None else ' by shape'}", self._share)

    def recorded(self, record: Record) -> None:
        """A step ended."""
        steps = list(STEPS)
        done = steps.index(record.step) + 1 if record.step in steps else len(steps)
        self._steps = len(steps) * (record.round - 1) + done
        self.seconds.append(self.elapsed)
        self.told(self.title, record)

    def reached(self, progress: Progress) -> None:
        """The start or a round is done: keep it."""
        self.checkpoint.save(progress, self.seconds)
        if progress.finished:
            self._ended, self._share = self._steps, 0.0

    def room(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """Surfaces on disk, and how many of them are there already."""
        room, self._there = self.checkpoint.room(shape)
        self._people = shape[0]
        return room, self._there

    def normalized(self, count: int) -> None:
        """So many surfaces are there."""
        self._there = count
        self.checkpoint.normalized(count, self.elapsed)
        self.tell(f"{self.title}: shapes", count / self._people)
