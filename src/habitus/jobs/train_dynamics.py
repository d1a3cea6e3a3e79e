"""From people in motion to a body with dynamics: open, fit what is not told, learn, evaluate, write
(S 6).
"""

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

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
from habitus.learn.dynamics.sequences import MovingSurface
from habitus.learn.dynamics.train import DynamicsOptions, LearnedDynamics, learn_dynamics
from habitus.parallel.choose import WorkersLike, open_workers
from habitus.parallel.workers import Workers
from habitus.types import PathLike, Progress

OURS = ("model.npz", "dynamics.json")


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
            "test": [_told(one) for one in self.errors],
            "options": asdict(self.options),
            "seconds": self.seconds,
        }


def train_dynamics(
    datasets: PathLike | Sequence[PathLike] | Sequence[MovingSurface],
    out: PathLike | None = None,
    *,
    body: PathLike | BodyModel = "default",
    test: PathLike | Sequence[PathLike] | Sequence[MovingSurface] = (),
    options: DynamicsOptions | None = None,
    fps: float | None = None,
    unit: str = "m",
    workers: WorkersLike = None,
    progress: Progress | None = None,
) -> DynamicsTraining:
    """Learn dynamic blend shapes of a body, and what predicts them from motion, and write them to
    the folder ``out``.

    datasets, and test, which is kept out of the training and gives the errors of S 6: what
    `habitus.io.registrations.motions.open_moving_surfaces` opens, or such sequences. Where they
    tell no betas, pose and trans, these are fitted first. body: a file, one of the bodies that come
    along, or a BodyModel; a file's other arrays and levels of detail are kept. ``fps`` and
    ``unit``: where the data do not tell them. ``out`` receives model.npz (the body with dynamics)
    and dynamics.json. Raises HabitusError, in one line, for bad input.
    """
    began = time.perf_counter()
    options = options or DynamicsOptions()
    progress = progress or _silent
    model = body if isinstance(body, BodyModel) else load_whole_body(os.fspath(body))
    given = [_opened(each, fps, unit) for each in (datasets, test)]
    if not given[0]:
        raise HabitusError("no sequences to learn from; expected people in motion")
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    with open_workers(workers) as ready:
        shown, kept = (_moving(model, each, ready, progress) for each in given)
        learned = learn_dynamics(model, shown, options, ready, progress)
        errors = evaluate_dynamics(learned.body, kept, ready) if kept else ()
    training = DynamicsTraining(learned, errors, time.perf_counter() - began, options)
    if folder is not None:
        with locked(folder, OURS):
            _write(training, body, folder)
    return training


def _opened(given: Any, fps: float | None, unit: str) -> list[MovingSurface]:
    paths = [given] if isinstance(given, str | os.PathLike) else list(given)
    found: list[MovingSurface] = []
    for one in paths:
        known = isinstance(one, MovingSurface)
        found += [one] if known else open_moving_surfaces(os.fspath(one), fps=fps, unit=unit)
    return found


def _moving(
    body: BodyModel, sequences: list[MovingSurface], workers: Workers, progress: Progress
) -> list[MovingSurface]:
    known = [one.for_body(body) for one in sequences]
    found = []
    for one in with_motions(body, known, workers):
        found.append(one)
        progress("motions", len(found) / len(known))
    return found


def _write(training: DynamicsTraining, body: PathLike | BodyModel, folder: Path) -> None:
    target = folder / "model.npz"
    if isinstance(body, BodyModel):
        save_body(training.body, target)
    else:
        save_dynamics(os.fspath(body), training.body, target)
    with atomic_write(folder / "dynamics.json") as temporary:
        temporary.write_text(json.dumps(training.numbers(), indent=1) + "\n", encoding="utf-8")


def _told(one: DynamicsErrors) -> dict[str, Any]:
    errors = {
        way: dict(zip(QUANTITIES, row, strict=True))
        for way, row in zip(MODES, one.errors.tolist(), strict=True)
    }
    return {
        "sequence": one.name,
        "subject": one.subject,
        "frames": len(one.fitted),
        "errors": errors,
    }


def _silent(stage: str, share: float) -> None:
    """Tells nobody."""
