"""State and callbacks of a training run: energy after each step, the estimate after each round, stored surfaces."""

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
    """Complete state of the alternation, as stored in a checkpoint; ``finished`` means that it has converged."""

    estimate: Estimate
    history: tuple[Record, ...]
    finished: bool

    @property
    def rounds(self) -> int:
        """Number of completed rounds."""
        return max((record.round for record in self.history), default=0)


class TrainingCallback(Protocol):
    """Called during training; also provides the storage for pose-normalised surfaces."""

    def on_step_end(self, record: Record) -> None:
        """After the initial estimate and after each step of a round."""
        ...

    def on_round_end(self, state: TrainingState) -> None:
        """After the initial estimate and after each round."""
        ...

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """An array (S,V,3) for the pose-normalised surfaces (m), and how many of them it already holds."""
        ...

    def on_surfaces_stored(self, count: int) -> None:
        """After the first ``count`` surfaces have been written to the store."""
        ...


@dataclass(frozen=True)
class NoCallback:
    """Does nothing; surfaces are kept in memory."""

    def on_step_end(self, record: Record) -> None:
        """Nothing."""

    def on_round_end(self, state: TrainingState) -> None:
        """Nothing."""

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """An empty float32 array."""
        return np.empty(shape, np.float32), 0

    def on_surfaces_stored(self, count: int) -> None:
        """Nothing."""
