"""From people in motion to a body with dynamics: open, fit what is not told, learn, evaluate, write
(S 6).
"""

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.dynamics import (
    MODES,
    QUANTITIES,
    DynamicsErrors,
    evaluate_dynamics,
    with_motions,
)
from habitus.files import atomic_write, locked
from habitus.io.models.bodies import load_whole_body, save_body, save_dynamics
from habitus.io.registrations.motions import open_moving_surfaces
from habitus.jobs.learn_options import UnitOption
from habitus.jobs.options import BodyOption, PythonOnly, silent, takes, unset
from habitus.learn.dynamics.sequences import MovingSurface
from habitus.learn.dynamics.settings import DYNAMICS, DynamicsSettings
from habitus.learn.dynamics.train import DynamicsOptions, LearnedDynamics, learn_dynamics
from habitus.parallel.workers import Workers, WorkersLike, open_workers
from habitus.types import PathLike, Progress

if TYPE_CHECKING:
    Sequences = PathLike | Sequence[PathLike] | Sequence[MovingSurface]
else:  # what a command line can say
    Sequences = tuple[Path, ...]

OURS = ("model.npz", "dynamics.json")


@dataclass(frozen=True, kw_only=True)
class DynamicsTrainingOptions(DynamicsOptions, UnitOption, BodyOption):
    """Options of `habitus train-dynamics`."""

    test: Annotated[Sequences, unset("DATASET …")] = ()
    """Held-out sequences, on which the errors of the surface's velocity and acceleration are
    measured.
    """
    settings: Annotated[DynamicsSettings, PythonOnly] = DYNAMICS
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second, where the data give none or a wrong one."""

    @property
    def training(self) -> DynamicsOptions:
        """The options of the training itself."""
        return DynamicsOptions(**{f.name: getattr(self, f.name) for f in fields(DynamicsOptions)})


@dataclass(frozen=True, eq=False)
class DynamicsTraining:
    """What was learned, its errors on sequences that were kept out (none where none were), seconds,
    and the options.
    """

    learned: LearnedDynamics
    errors: tuple[DynamicsErrors, ...]
    seconds: float
    options: DynamicsOptions

    @property
    def body(self) -> BodyModel:
        """The body with dynamics, at its full level of detail."""
        return self.learned.body

    def numbers(self) -> dict[str, Any]:
        """The content of dynamics.json."""
        learned = self.learned
        dynamics = self.body.dynamics
        assert dynamics is not None
        best = learned.choices[0]
        return {
            "body": self.body.name,
            "rate_hz": dynamics.regressor.rate_hz,
            "frames": sum(map(len, learned.coefficients)),
            "sequences": len(learned.coefficients),
            "variance_shares": learned.shares.tolist(),
            "size_mm": (1e3 * np.sqrt((dynamics.directions**2).sum(1).max(0))).tolist(),
            "modes": [
                {"frequency_hz": hz, "damping_ratio": ratio} for hz, ratio in learned.modes.tolist()
            ],
            "chosen": asdict(best),
            "choices": [asdict(choice) for choice in learned.choices],
            "test": [_error_numbers(errors) for errors in self.errors],
            "options": asdict(self.options),
            "seconds": self.seconds,
        }


@takes(DynamicsTrainingOptions)
def train_dynamics(
    datasets: PathLike | Sequence[PathLike] | Sequence[MovingSurface],
    out: PathLike | None = None,
    *,
    options: DynamicsTrainingOptions,
    workers: WorkersLike = None,
    progress: Progress = silent,
) -> DynamicsTraining:
    """Learn dynamic blend shapes of a body, and what predicts them from motion; ``out`` receives
    model.npz (the body with dynamics) and dynamics.json.

    datasets and the held-out ``test``: what
    `habitus.io.registrations.motions.open_moving_surfaces` opens, or such sequences. Where these
    have no betas, pose and trans, these are fitted first. Of a body's file other arrays and levels
    of detail are kept. Raises HabitusError, in one line, for bad input.
    """
    began = time.perf_counter()
    body = options.body
    model = body if isinstance(body, BodyModel) else load_whole_body(os.fspath(body))
    given = [_opened(each, options.fps, options.unit) for each in (datasets, options.test)]
    if not given[0]:
        raise HabitusError("no sequences to learn from; expected people in motion")
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    with open_workers(workers) as ready:
        shown, kept = (_moving(model, each, ready, progress) for each in given)
        learned = learn_dynamics(model, shown, options.training, ready, progress)
        errors = evaluate_dynamics(learned.body, kept, ready) if kept else ()
    training = DynamicsTraining(learned, errors, time.perf_counter() - began, options.training)
    if folder is not None:
        with locked(folder, OURS):
            _write(training, body, folder)
    return training


def _opened(given: Any, fps: float | None, unit: str) -> list[MovingSurface]:
    paths = [given] if isinstance(given, str | os.PathLike) else list(given)
    sequences: list[MovingSurface] = []
    for source in paths:
        known = isinstance(source, MovingSurface)
        sequences += (
            [source] if known else open_moving_surfaces(os.fspath(source), fps=fps, unit=unit)
        )
    return sequences


def _moving(
    body: BodyModel, sequences: list[MovingSurface], workers: Workers, progress: Progress
) -> list[MovingSurface]:
    known = [each.for_body(body) for each in sequences]
    moving = []
    for each in with_motions(body, known, workers):
        moving.append(each)
        progress("motions", len(moving) / len(known))
    return moving


def _write(training: DynamicsTraining, body: PathLike | BodyModel, folder: Path) -> None:
    target = folder / "model.npz"
    if isinstance(body, BodyModel):
        save_body(training.body, target)
    else:
        save_dynamics(os.fspath(body), training.body, target)
    with atomic_write(folder / "dynamics.json") as temporary:
        temporary.write_text(json.dumps(training.numbers(), indent=1) + "\n", encoding="utf-8")


def _error_numbers(result: DynamicsErrors) -> dict[str, Any]:
    errors = {
        way: dict(zip(QUANTITIES, row, strict=True))
        for way, row in zip(MODES, result.errors.tolist(), strict=True)
    }
    return {
        "sequence": result.name,
        "subject": result.subject,
        "frames": len(result.fitted),
        "errors": errors,
    }
