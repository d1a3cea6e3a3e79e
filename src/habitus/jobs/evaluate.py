"""From trained models and held-out registrations to the figures of the papers: read, fit, time, write (S 5).

`habitus evaluate` calls this.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from habitus.errors import HabitusError
from habitus.evaluate.generalisation import COUNTS, model_generalisation, pose_generalisation
from habitus.evaluate.neck_twist import NeckTwist, neck_twist, twist_joints
from habitus.evaluate.posable import PosableBody
from habitus.evaluate.result import Evaluation, Model, ModelEvaluation
from habitus.evaluate.timing import ForwardTimes, time_forward
from habitus.io.registrations.open import open_registrations
from habitus.jobs.evaluation_models import (
    Loaded,
    check_topology,
    load_models,
    rest_template,
    shape_variances,
)
from habitus.learn.checks import check_registrations, refuse
from habitus.mesh.registrations import Registrations, Vertices
from habitus.parallel.workers import Threads, Workers
from habitus.types import PathLike, Progress


def evaluate(
    models: Sequence[PathLike],
    dataset: PathLike,
    out: PathLike | None = None,
    *,
    which: str = "test",
    sex: str | None = None,
    counts: Sequence[int] = COUNTS,
    clean: PathLike | None = None,
    plain: bool = False,
    unit: str = "m",
    repeats: int = 20,
    workers: Workers | None = None,
    progress: Progress = lambda stage, share: None,
) -> Evaluation:
    """Measure models (files, or "default") on the registrations of the set ``which`` and write what comes out (S 5).

    ``dataset`` and ``clean``, the same registrations without noise, are what `open_registrations` takes. ``plain`` adds
    each model with pose blend shapes once more without them, as S 5.1 does. Where ``out`` is given it receives
    report.html, evaluation.json, per_vertex.npz, and the folder figures. Raises HabitusError with one clear line on bad
    input.
    """
    if not models:
        raise HabitusError("no model was given; expected one or more model files, or 'default'")
    if repeats < 1:
        raise HabitusError(f"{repeats} repeats asked for; expected at least 1")
    loaded = load_models(models, plain)
    registrations = open_registrations(dataset, unit=unit).where(set=which, sex=sex)
    if not len(registrations):
        whose = f" of sex {sex!r}" if sex else ""
        raise HabitusError(f"{dataset} has no registrations of the set {which!r}{whose}; choose another with --set")
    true = (
        None
        if clean is None
        else _twins(open_registrations(clean, unit=unit).where(set=which, sex=sex), registrations, clean)
    )
    for one in loaded:
        check_topology(one.model, registrations, dataset)
    refuse(check_registrations(registrations, rest_template(loaded[0].model)))
    if out is not None:
        from habitus.jobs.evaluation_files import prepare_folder  # complains before hours of fits, not after

        prepare_folder(Path(out))
    found = _measured(
        loaded, registrations, counts, true, repeats, workers or Threads(len(os.sched_getaffinity(0))), progress
    )
    evaluation = Evaluation(str(dataset), registrations, true, found)
    if out is not None:
        from habitus.jobs.evaluation_files import write_evaluation

        progress("write", 1.0)
        write_evaluation(evaluation, Path(out))
    return evaluation


def _twins(clean: Registrations, registrations: Registrations, path: PathLike) -> Vertices:
    """The vertices without noise of each registration, found by its name."""
    if clean.num_vertices != registrations.num_vertices:
        raise HabitusError(
            f"{path} has meshes of {clean.num_vertices} vertices; expected {registrations.num_vertices}, as the dataset"
        )
    rows = {name: k for k, name in enumerate(clean.name)}
    missing = [name for name in registrations.name if name not in rows]
    if missing or len(rows) != len(clean):
        raise HabitusError(
            f"{path} holds no mesh called {missing[0]}, as the dataset does; expected the same names"
            if missing
            else f"{path} holds several meshes of one name; expected a name each, those of the dataset"
        )
    return clean.take(np.array([rows[name] for name in registrations.name])).vertices


# -- measures ---------------------------------------------------------------------------------------------------------


def _measured(
    loaded: Sequence[Loaded],
    registrations: Registrations,
    counts: Sequence[int],
    clean: Vertices | None,
    repeats: int,
    workers: Workers,
    progress: Progress,
) -> tuple[ModelEvaluation, ...]:
    several = len(registrations) > len(registrations.subjects)
    fits = len(loaded) * (len(registrations) + several * (len(registrations) - len(registrations.subjects)))
    watched, shapes, poses = _Watched(workers, progress, fits), [], []
    for one in loaded:
        watched.stage = f"model generalisation of {one.model.name}"
        fitted = model_generalisation(one.model, registrations, counts, clean=clean, workers=watched)
        watched.stage = f"pose generalisation of {one.model.name}"
        shapes.append(fitted)
        poses.append(
            pose_generalisation(one.model, registrations, fitted, clean=clean, workers=watched) if several else None
        )
    progress("run time", 1.0)
    times = _times(loaded, counts, repeats)
    twists = _twists(loaded)
    return tuple(
        ModelEvaluation(
            one.model, one.file, one.twin, *curves, times[one.model.name], *shape_variances(one.model, one.file), twist
        )
        for one, *curves, twist in zip(loaded, shapes, poses, twists, strict=True)
    )


def _times(loaded: Sequence[Loaded], counts: Sequence[int], repeats: int) -> dict[str, ForwardTimes]:
    """Models with as many joints take turns."""
    by_joints: dict[int, list[Model]] = {}
    for one in loaded:
        by_joints.setdefault(len(one.model.parents), []).append(one.model)
    used = (0, *counts)
    found = (time_forward(group, used, joints=joints, repeats=repeats) for joints, group in by_joints.items())
    return {times.model: times for group in found for times in group}


def _twists(loaded: Sequence[Loaded]) -> list[NeckTwist | None]:
    bodies = {one.model.name: one.model.body for one in loaded if isinstance(one.model, PosableBody)}
    necks = {name: body for name, body in bodies.items() if twist_joints(body.joint_names, body.parents)}
    found = dict(zip(necks, neck_twist([replace(body, name=name) for name, body in necks.items()]), strict=True))
    return [found.get(one.model.name) for one in loaded]


class _Watched:
    """Workers that tell how far all fits have come."""

    def __init__(self, workers: Workers, progress: Progress, total: int):
        self.workers, self.progress, self.total = workers, progress, total
        self.done, self.stage = 0, ""

    def map(self, function: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]) -> Iterator[Any]:
        """As the workers do it."""
        self.progress(self.stage, self.done / self.total)
        for result in self.workers.map(function, shared, items):
            self.done += 1
            self.progress(self.stage, self.done / self.total)
            yield result
