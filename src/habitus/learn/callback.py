"""State and callbacks of a training run: energy and estimate after each step, stored surfaces."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from habitus.learn.energy import Energy
from habitus.learn.estimate import Estimate


@dataclass(frozen=True)
class Record:
    """The energy after a step of a round; round 0 is the initial estimate."""

    round: int
    step: str
    energy: Energy


@dataclass(frozen=True, eq=False)
class TrainingState:
    """Complete state of the alternation, as stored in a checkpoint; ``finished`` means that it has
    converged.

    ``before`` is the estimate at the beginning of a round that is under way, None between rounds.
    """

    estimate: Estimate
    history: tuple[Record, ...]
    finished: bool
    before: Estimate | None = None

    @property
    def rounds(self) -> int:
        """Number of completed rounds."""
        begun = max((record.round for record in self.history), default=0)
        return begun if self.before is None else begun - 1

    @property
    def steps_done(self) -> tuple[str, ...]:
        """The steps that are done of the round under way."""
        return tuple(record.step for record in self.history if record.round > self.rounds)


class TrainingCallback(Protocol):
    """Called during training; also provides the storage for pose-normalised surfaces."""

    def on_step_end(self, record: Record) -> None:
        """After the initial estimate and after each step of a round."""
        ...

    def on_state(self, state: TrainingState) -> None:
        """After each step within a round: where the training may go on."""
        ...

    def on_round_end(self, state: TrainingState) -> None:
        """After the initial estimate and after each round."""
        ...

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """An array (S,V,3) for the pose-normalised surfaces (m), and how many of them it already
        holds.
        """
        ...

    def on_surfaces_stored(self, count: int) -> None:
        """After the first ``count`` surfaces have been written to the store."""
        ...


@dataclass(frozen=True)
class NoCallback:
    """Does nothing; surfaces are kept in memory."""

    def on_step_end(self, record: Record) -> None:
        """Nothing."""

    def on_state(self, state: TrainingState) -> None:
        """Nothing."""

    def on_round_end(self, state: TrainingState) -> None:
        """Nothing."""

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """An empty float32 array."""
        return np.empty(shape, np.float32), 0

    def on_surfaces_stored(self, count: int) -> None:
        """Nothing."""
