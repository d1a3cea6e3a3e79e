"""Evaluation of body models on held-out registrations: read, fit, time, write (S 5).

`habitus evaluate` calls this.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.counts import COUNTS
from habitus.evaluate.generalisation import (
    Generalisation,
    model_generalisation,
    pose_generalisation,
)
from habitus.evaluate.neck_twist import NeckTwist, neck_twist, twist_joints
from habitus.evaluate.posable import ComparedModel, PosableBody
from habitus.evaluate.result import Evaluation, ForwardTimes, ModelEvaluation, time_forward
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
from habitus.parallel.choose import WorkersLike, open_workers, thread_count
from habitus.parallel.workers import ReportingWorkers, Workers
from habitus.types import PathLike, Progress


def evaluate(
    models: Sequence[PathLike | BodyModel | ComparedModel],
    dataset: PathLike | Registrations,
    out: PathLike | None = None,
    *,
    split: str = "test",
    sex: str | None = None,
    counts: Sequence[int] = COUNTS,
    clean: PathLike | Registrations | None = None,
    plain: bool = False,
    unit: str = "m",
    repeats: int = 20,
    workers: WorkersLike = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Evaluation:
    """Measure models on the registrations of the set ``split`` and, where ``out`` is given, write
    the results (S 5).

    models: files, "default", BodyModel objects, or models of another kind
    (`habitus.evaluate.posable.ComparedModel`). dataset and clean (the same registrations without
    noise): what `open_registrations` takes, or open Registrations (m). sex: "female" or
    "male", only registrations of these. plain: measure each model with pose blend shapes also
    without them, as S 5.1 does. repeats and seed: of the run times, and of their random shapes and
    poses. workers: number of threads (default: one per core), address of a Dask scheduler, or
    Workers. ``out`` receives report.html, evaluation.json, per_vertex.npz and the folder figures.
    Raises HabitusError, in one line, for bad input.
    """
    progress = progress or (lambda stage, share: None)
    if not models:
        raise HabitusError("no model was given; expected one or more model files, or 'default'")
    if repeats < 1:
        raise HabitusError(f"{repeats} repeats asked for; expected at least 1")
    if isinstance(workers, int):
        thread_count(workers)
    loaded = load_models(models, plain)
    source = _source(dataset, "the dataset")
    registrations = _opened(dataset, unit).where(set=split, sex=sex)
    if not len(registrations):
        whose = f" of sex {sex!r}" if sex else ""
        raise HabitusError(
            f"{source} has no registrations of the set {split!r}{whose}; "
            "choose another with --split"
        )
    true = None
    if clean is not None:
        clean_set = _opened(clean, unit).where(set=split, sex=sex)
        true = _clean_vertices(clean_set, registrations, _source(clean, "the clean dataset"))
    for one in loaded:
        check_topology(one.model, registrations, source)
    refuse(check_registrations(registrations, rest_template(loaded[0].model), holes=False))
    with _prepared(out), open_workers(workers) as ready:
        fitted = _fitted(loaded, registrations, counts, true, ready, progress)
        progress("run time", 1.0)
        found = _assembled(loaded, fitted, _times(loaded, counts, repeats, seed))
        evaluation = Evaluation(source, registrations, true, found)
        if out is not None:
            from habitus.jobs.evaluation_files import write_evaluation

            progress("write", 1.0)
            write_evaluation(evaluation, Path(out))
    return evaluation


def _prepared(out: PathLike | None) -> AbstractContextManager[None]:
    """The folder locked and found fit to be written to, before hours of fits and not after."""
    if out is None:
        return nullcontext()
    from habitus.jobs.evaluation_files import prepared_folder

    return prepared_folder(Path(out))


def _source(dataset: PathLike | Registrations, otherwise: str) -> str:
    """For messages and evaluation.json."""
    return otherwise if isinstance(dataset, Registrations) else str(dataset)


def _opened(dataset: PathLike | Registrations, unit: str) -> Registrations:
    return dataset if isinstance(dataset, Registrations) else open_registrations(dataset, unit=unit)


def _clean_vertices(clean: Registrations, registrations: Registrations, path: str) -> Vertices:
    """The vertices without noise of each registration, found by its name."""
    if clean.num_vertices != registrations.num_vertices:
        raise HabitusError(
            f"{path} has meshes of {clean.num_vertices} vertices; expected "
            f"{registrations.num_vertices}, as the dataset"
        )
    rows = {name: k for k, name in enumerate(clean.name)}
    missing = [name for name in registrations.name if name not in rows]
    if missing or len(rows) != len(clean):
        raise HabitusError(
            f"{path} holds no mesh called {missing[0]}, as the dataset does; expected the same "
            "names"
            if missing
            else f"{path} holds several meshes of one name; expected a name each, those of the "
            "dataset"
        )
    return clean.take(np.array([rows[name] for name in registrations.name])).vertices


# -- measures --------------------------------------------------------------------------------------


_Curves = tuple[Generalisation, Generalisation | None]
"""Model and pose generalisation of one model; the latter needs people in several poses."""


def _fitted(
    loaded: Sequence[Loaded],
    registrations: Registrations,
    counts: Sequence[int],
    clean: Vertices | None,
    workers: Workers,
    progress: Progress,
) -> list[_Curves]:
    several = len(registrations) > len(registrations.subjects)
    total = len(loaded) * (
        len(registrations) + several * (len(registrations) - len(registrations.subjects))
    )
    before = 0
    found = []

    def reporting(stage: str) -> ReportingWorkers:
        """Workers that report the share of all fits."""
        start = before
        progress(stage, start / total)
        return ReportingWorkers(workers, lambda done, _: progress(stage, (start + done) / total))

    for one in loaded:
        stage = f"model generalisation of {one.model.name}"
        shape = model_generalisation(
            one.model, registrations, counts, clean=clean, workers=reporting(stage)
        )
        before += len(shape.rows)
        pose = None
        if several:
            stage = f"pose generalisation of {one.model.name}"
            pose = pose_generalisation(
                one.model, registrations, shape, clean=clean, workers=reporting(stage)
            )
            before += len(pose.rows)
        found.append((shape, pose))
    return found


def _assembled(
    loaded: Sequence[Loaded], fitted: Sequence[_Curves], times: dict[str, ForwardTimes]
) -> tuple[ModelEvaluation, ...]:
    return tuple(
        ModelEvaluation(
            one.model,
            one.file,
            one.without_pose_shapes_of,
            *curves,
            times[one.model.name],
            *shape_variances(one.model, one.file),
            twist,
        )
        for one, curves, twist in zip(loaded, fitted, _twists(loaded), strict=True)
    )


def _times(
    loaded: Sequence[Loaded], counts: Sequence[int], repeats: int, seed: int
) -> dict[str, ForwardTimes]:
    """Models with as many joints take turns."""
    by_joints: dict[int, list[ComparedModel]] = {}
    for one in loaded:
        by_joints.setdefault(len(one.model.parents), []).append(one.model)
    used = (0, *counts)
    options = {"repeats": repeats, "seed": seed}
    found = (
        time_forward(group, used, joints=joints, **options) for joints, group in by_joints.items()
    )
    return {times.model: times for group in found for times in group}


def _twists(loaded: Sequence[Loaded]) -> list[NeckTwist | None]:
    bodies = {
        one.model.name: one.model.body for one in loaded if isinstance(one.model, PosableBody)
    }
    necks = {
        name: body for name, body in bodies.items() if twist_joints(body.joint_names, body.parents)
    }
    found = dict(
        zip(
            necks,
            neck_twist([replace(body, name=name) for name, body in necks.items()]),
            strict=True,
        )
    )
    return [found.get(one.model.name) for one in loaded]
