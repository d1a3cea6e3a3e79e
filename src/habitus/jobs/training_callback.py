"""Callback of a training run from files to files: checkpoints, seconds of work, share done."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from habitus.jobs.checkpoints import Checkpoint
from habitus.learn.callback import NoCallback, Record, TrainingState
from habitus.learn.steps.alternation import STEPS
from habitus.types import Progress


@dataclass(frozen=True)
class Callbacks:
    """Whom a run tells how far it is, the energy after each step of a model, and warnings."""

    progress: Progress
    on_step: Callable[[str, Record], None]
    on_warning: Callable[[str], None]

    @staticmethod
    def of(
        progress: Progress | None,
        on_step: Callable[[str, Record], None] | None,
        on_warning: Callable[[str], None] | None,
    ) -> "Callbacks":
        """Those that are None do nothing."""
        return Callbacks(
            progress or (lambda stage, share: None),
            on_step or (lambda model, record: None),
            on_warning or (lambda text: None),
        )


class CheckpointingCallback:
    """Stores checkpoints of a training, sums its seconds of work over all runs, and reports
    progress.

    Stages are "poses by edges", "rounds" (at most ``rounds`` of them), "shapes" and, where pose
    blend shapes depend on shape, "rounds by shape", each preceded by ``title``. ``state`` is where
    an earlier run stopped, or None. Without a ``checkpoint`` nothing is written and surfaces are
    kept in memory.
    """

    def __init__(
        self,
        title: str,
        checkpoint: Checkpoint | None,
        rounds: int,
        progress: Progress,
        on_step: Callable[[str, Record], None],
    ):
        self.title = title
        self.checkpoint = checkpoint
        self.progress = progress
        self.on_step = on_step
        self.state, self.seconds = checkpoint.load() if checkpoint else (None, [])
        self._total_steps = rounds * len(STEPS)
        self._steps = (
            len(STEPS) * self.state.rounds + len(self.state.steps_done) if self.state else -1
        )  # -1: not begun
        self._ended: int | None = None  # steps of the first rounds, once these are over
        self._kept = len(self.state.history) if self.state else 0  # records in the checkpoint
        self._share = 0.0
        self._surfaces = 0
        self._stored = 0
        self._earlier = max([0.0, *self.seconds[-1:], checkpoint.seconds if checkpoint else 0.0])
        self._began = time.perf_counter()

    @property
    def elapsed(self) -> float:
        """Seconds of work so far, including earlier runs."""
        return self._earlier + time.perf_counter() - self._began

    def on_item(self, done: int, total: int) -> None:
        """After ``done`` of ``total`` items of a parallel map, which is part of a step."""
        if self._stored < self._surfaces:
            return
        if self._steps < 0:
            self.progress(f"{self.title}: poses by edges", done / total)
            return
        step = (self._steps - (self._ended or 0) + done / total) / self._total_steps
        self._share = min(1.0, max(self._share, step))
        self.progress(
            f"{self.title}: rounds{'' if self._ended is None else ' by shape'}", self._share
        )

    def on_step_end(self, record: Record) -> None:
        """Note the seconds and report the energy."""
        steps = list(STEPS)
        done = steps.index(record.step) + 1 if record.step in steps else len(steps)
        self._steps = len(steps) * (record.round - 1) + done
        self.seconds.append(self.elapsed)
        self.on_step(self.title, record)

    def on_state(self, state: TrainingState) -> None:
        """Write the checkpoint."""
        if self.checkpoint and len(state.history) > self._kept:
            self.checkpoint.save(state, self.seconds)
            self._kept = len(state.history)

    def on_round_end(self, state: TrainingState) -> None:
        """Write the checkpoint."""
        self.on_state(state)
        if state.finished:
            self._ended = self._steps
            self._share = 0.0

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """An array (S,V,3), on disk where there is a checkpoint, and how many surfaces it already
        holds.
        """
        store, self._stored = (self.checkpoint or NoCallback()).surface_store(shape)
        self._surfaces = shape[0]
        return store, self._stored

    def on_surfaces_stored(self, count: int) -> None:
        """Write how many surfaces are stored, and report progress."""
        self._stored = count
        if self.checkpoint:
            self.checkpoint.on_surfaces_stored(count, self.elapsed)
        self.progress(f"{self.title}: shapes", count / self._surfaces)
