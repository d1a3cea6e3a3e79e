"""Evaluation of body models on held-out registrations: read, fit, time, write (S 5).

`habitus evaluate` calls this.
"""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.joint_layouts import LAYOUTS
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.generalisation import (
    Generalisation,
    model_generalisation,
    pose_generalisation,
)
from habitus.evaluate.known_state import KnownErrors, known_errors
from habitus.evaluate.neck_twist import NeckTwist, neck_twist, twist_joints
from habitus.evaluate.posable import ComparedModel, PosableBody, without_pose_shapes
from habitus.evaluate.result import Evaluation, ForwardTimes, ModelEvaluation, time_forward
from habitus.files import atomic_write, writable_folder
from habitus.io.models.bodies import load_body
from habitus.io.models.levels import has_levels
from habitus.io.registrations.open import open_registrations
from habitus.io.registrations.templates import body_template
from habitus.jobs.learn_options import DatasetOptions, EvaluationOptions
from habitus.jobs.options import silent, takes
from habitus.learn.checks import check_registrations, refuse
from habitus.mesh.registrations import Registrations, Vertices
from habitus.mesh.template import Template
from habitus.parallel.workers import (
    ReportingWorkers,
    Workers,
    WorkersLike,
    open_workers,
    thread_count,
)
from habitus.types import PathLike, Progress


@dataclass(frozen=True, eq=False)
class Loaded:
    """A model, its file (None for one given as such), and whose copy without pose blend shapes
    it is, if any.
    """

    model: ComparedModel
    file: str | None
    without_pose_shapes_of: str | None = None


def load_models(
    models: Sequence[PathLike | BodyModel | ComparedModel], plain: bool
) -> list[Loaded]:
    """The models of files (or "default"), bodies and other models; with ``plain`` each body also
    without its pose blend shapes.

    Raises HabitusError for files that are no models, and for two models of one name.
    """
    opened = []
    for given, name in zip(models, model_names(models), strict=True):
        model = _load(given, name)
        file = str(given) if isinstance(given, (str, os.PathLike)) else None
        opened.append(Loaded(model, file))
        if plain and isinstance(model, PosableBody) and model.body.posedirs is not None:
            body = without_pose_shapes(model.body)
            opened.append(Loaded(PosableBody(body, f"{name}, plain"), file, name))
    return opened


def rest_template(model: ComparedModel) -> Template:
    """The model at rest, cut by strongest joints: what registrations are checked against."""
    if isinstance(model, PosableBody):
        return body_template(model.body)
    names = tuple(f"joint {k}" for k in range(len(model.parents)))
    return Template(model.template, model.faces, model.influence.argmax(1), model.parents, names)


def model_names(models: Sequence[PathLike | BodyModel | ComparedModel]) -> list[str]:
    """Bodies' own names; files' names, the folder's for a model.npz, both where one alone is not
    unique.
    """
    stems = [
        _stem(Path(model)) if isinstance(model, (str, os.PathLike)) else model.name
        for model in models
    ]
    names = [
        stem
        if stems.count(stem) == 1 or not isinstance(model, (str, os.PathLike))
        else f"{Path(model).resolve().parent.name}/{Path(model).stem}"
        for stem, model in zip(stems, models, strict=True)
    ]
    for name, model in zip(names, models, strict=True):
        if names.count(name) > 1:
            source = model if isinstance(model, (str, os.PathLike)) else "not of a file"
            raise HabitusError(
                f"two models are called {name} ({source}); expected names that differ: rename one"
            )
    return names


def _stem(path: Path) -> str:
    return path.resolve().parent.name if path.stem == "model" else path.stem


def _load(given: PathLike | BodyModel | ComparedModel, name: str) -> ComparedModel:
    body = load_body(os.fspath(given)) if isinstance(given, (str, os.PathLike)) else given
    return PosableBody(replace(body, name=name), name) if isinstance(body, BodyModel) else body


def check_topology(model: ComparedModel, registrations: Registrations, dataset: str) -> None:
    """Raise HabitusError unless a model has the registrations' vertices and faces."""
    faces = model.faces
    count = len(model.template)
    if count != registrations.num_vertices or not _same_faces(faces, registrations.faces):
        raise HabitusError(
            f"{model.name} has {count} vertices and {len(faces)} faces, another topology than "
            f"{dataset} with "
            f"{registrations.num_vertices} and {len(registrations.faces)}; expected a model "
            "trained on such meshes"
        )


def _same_faces(one: np.ndarray, other: np.ndarray) -> bool:
    first, second = (np.sort(np.asarray(faces, np.int64), axis=1) for faces in (one, other))
    return one.shape == other.shape and np.array_equal(
        first[np.lexsort(first.T)], second[np.lexsort(second.T)]
    )


def shape_variances(model: ComparedModel, file: str | None) -> tuple[Float[np.ndarray, " S"], bool]:
    """Variances along shape directions, and whether these are all that the model was trained on.

    They are kept with the model or in the training.json beside it; else they are those of the
    model's own directions, which are scaled to one standard deviation.
    """
    kept = model.shape_variances
    if kept is None and file is not None:
        kept = _training_variances(Path(file))
    directions = np.asarray(model.shape_directions).reshape(model.num_betas, -1)
    if kept is not None:
        return np.asarray(kept, float).reshape(-1), True
    return (directions**2).sum(1), False


def _training_variances(file: Path) -> list[float] | None:
    """Those of the training.json beside the file."""
    try:
        record = json.loads((file.parent / "training.json").read_text("utf-8"))
        return (record if file.stem == "model" else record["baselines"][file.stem])[
            "shape_variances"
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return None


@takes(EvaluationOptions)
def evaluate(
    models: Sequence[PathLike | BodyModel | ComparedModel],
    dataset: PathLike | Registrations,
    out: PathLike | None = None,
    *,
    options: EvaluationOptions,
    workers: WorkersLike = None,
    progress: Progress = silent,
) -> Evaluation:
    """Measure models on the registrations of a set of the dataset; ``out`` receives the results (S
    5).

    models: files, "default", BodyModel objects, or models of another kind
    (`habitus.evaluate.posable.ComparedModel`). dataset and clean (the same registrations
    without noise): what `open_registrations` takes, or open Registrations (m). workers: number of
    threads (default: one per core), address of a Dask scheduler, or Workers. ``out`` receives
    report.html, evaluation.json, per_vertex.npz and the folder figures. Raises HabitusError, in one
    line, for bad input.
    """
    if not models:
        raise HabitusError("no model was given; expected one or more model files, or 'default'")
    if options.repeats < 1:
        raise HabitusError(f"{options.repeats} repeats asked for; expected at least 1")
    if isinstance(workers, int):
        thread_count(workers)
    loaded = load_models(models, options.plain)
    source = _source(dataset, "the dataset")
    registrations = _chosen(dataset, options)
    clean = options.clean
    counts = options.counts
    if not len(registrations):
        whose = f" of sex {options.sex!r}" if options.sex else ""
        raise HabitusError(
            f"{source} has no registrations of the set {options.split!r}{whose}; choose another "
            "with --split"
        )
    true = None
    if clean is not None:
        true = _clean_vertices(
            _chosen(clean, options), registrations, _source(clean, "the clean dataset")
        )
    for each in loaded:
        check_topology(each.model, registrations, source)
    refuse(check_registrations(registrations, rest_template(loaded[0].model)))
    with _prepared(out), open_workers(workers) as ready:
        fitted = _fitted(loaded, registrations, counts, true, ready, progress)
        progress("run time", 1.0)
        result = _assembled(loaded, fitted, _times(loaded, counts, options.repeats, options.seed))
        evaluation = Evaluation(source, registrations, true, result)
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


def _opened(dataset: PathLike | Sequence[PathLike] | Registrations, unit: str) -> Registrations:
    if isinstance(dataset, Registrations):
        return dataset
    paths = [dataset] if isinstance(dataset, str | os.PathLike) else dataset
    return open_registrations([os.fspath(path) for path in paths], unit=unit)


def _chosen(dataset: PathLike | Registrations, options: DatasetOptions) -> Registrations:
    """The registrations of the set and sex."""
    return _opened(dataset, options.unit).where(set=options.split, sex=options.sex)


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
    curves = []

    def reporting(stage: str) -> ReportingWorkers:
        """Workers that report the share of all fits."""
        start = before
        progress(stage, start / total)
        return ReportingWorkers(workers, lambda done, _: progress(stage, (start + done) / total))

    for each in loaded:
        stage = f"model generalisation of {each.model.name}"
        shape = model_generalisation(
            each.model, registrations, counts, clean=clean, workers=reporting(stage)
        )
        before += len(shape.rows)
        pose = None
        if several:
            stage = f"pose generalisation of {each.model.name}"
            pose = pose_generalisation(
                each.model, registrations, shape, clean=clean, workers=reporting(stage)
            )
            before += len(pose.rows)
        curves.append((shape, pose))
    return curves


def _assembled(
    loaded: Sequence[Loaded], fitted: Sequence[_Curves], times: dict[str, ForwardTimes]
) -> tuple[ModelEvaluation, ...]:
    return tuple(
        ModelEvaluation(
            each.model,
            each.file,
            each.without_pose_shapes_of,
            *curves,
            times[each.model.name],
            *shape_variances(each.model, each.file),
            twist,
        )
        for each, curves, twist in zip(loaded, fitted, _twists(loaded), strict=True)
    )


def _times(
    loaded: Sequence[Loaded], counts: Sequence[int], repeats: int, seed: int
) -> dict[str, ForwardTimes]:
    """Models with as many joints take turns."""
    by_joints: dict[int, list[ComparedModel]] = {}
    for each in loaded:
        by_joints.setdefault(len(each.model.parents), []).append(each.model)
    used = (0, *counts)
    options = {"repeats": repeats, "seed": seed}
    measured = (
        time_forward(group, used, joints=joints, **options) for joints, group in by_joints.items()
    )
    return {times.model: times for group in measured for times in group}


def _twists(loaded: Sequence[Loaded]) -> list[NeckTwist | None]:
    bodies = {
        each.model.name: each.model.body for each in loaded if isinstance(each.model, PosableBody)
    }
    necks = {
        name: body for name, body in bodies.items() if twist_joints(body.joint_names, body.parents)
    }
    twists = dict(
        zip(
            necks,
            neck_twist([replace(body, name=name) for name, body in necks.items()]),
            strict=True,
        )
    )
    return [twists.get(each.model.name) for each in loaded]


WHO = ("all", "new people", "known people")


@dataclass(frozen=True, eq=False)
class KnownEvaluation:
    """For each model and group of people (`WHO`, those there are) mean, rms and p95 of vertex
    distance (m), and the share of the first model's plain LBS error (mean) that is gone.
    """

    models: Mapping[str, Mapping[str, Mapping[str, float]]]
    registrations: int
    errors: Mapping[str, KnownErrors]


@takes(DatasetOptions)
def evaluate_known(
    models: Sequence[PathLike | BodyModel],
    dataset: PathLike | Sequence[PathLike] | Registrations,
    out: PathLike | None = None,
    *,
    options: DatasetOptions,
    workers: WorkersLike = None,
    progress: Progress = silent,
) -> KnownEvaluation:
    """Errors of body models in the known poses and shapes of the registrations of a set.

    The first model is also measured as plain LBS and plain DQBS, without its pose blend shapes. Of
    a body of two levels of detail the one of the dataset's topology is taken. New people are those
    of whom the dataset has no registration in another set. ``out`` receives known.json. Raises
    HabitusError for bad input.
    """
    if not models:
        raise HabitusError("no model was given; expected one or more model files, or 'default'")
    split = options.split
    everything = _opened(dataset, options.unit)
    data = everything.where(set=split, sex=options.sex)
    if not len(data):
        raise HabitusError(
            f"the dataset has no registrations of the set {split!r}; choose another with --split"
        )
    bodies = _bodies(models, data)
    with open_workers(workers) as ready:
        report = ReportingWorkers(ready, lambda done, total: progress("known poses", done / total))
        errors = known_errors(bodies, data, report)
    others = {
        subject
        for subject, where in zip(everything.subject, everything.set, strict=True)
        if where != split
    }
    known = np.array([subject in others for subject in data.subject])
    groups = {
        name: rows
        for name, rows in zip(WHO, (known | ~known, ~known, known), strict=True)
        if rows.any()
    }
    plain = next(iter(errors))
    means = {
        name: {
            who: {
                **error.over(rows),
                "removed": 1 - error.over(rows)["mean"] / errors[plain].over(rows)["mean"],
            }
            for who, rows in groups.items()
        }
        for name, error in errors.items()
    }
    evaluation = KnownEvaluation(means, len(data), errors)
    if out is not None:
        with atomic_write(writable_folder(Path(out)) / "known.json") as temporary:
            record = {"registrations": len(data), "set": split, "metres": means}
            temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False), encoding="utf-8")
    return evaluation


def _bodies(models: Sequence[PathLike | BodyModel], data: Registrations) -> dict[str, BodyModel]:
    """Plain LBS and DQBS of the first model, then all as they are."""
    loaded = [_body(model, data) for model in models]
    plain = replace(without_pose_shapes(loaded[0]), pose_joints=None)
    evaluated = {
        "plain LBS": replace(plain, skinning="lbs"),
        "plain DQBS": replace(plain, skinning="dqbs"),
    }
    return evaluated | dict(zip(model_names(models), loaded, strict=True))


def _body(model: PathLike | BodyModel, data: Registrations) -> BodyModel:
    """A model with the joints and the level of detail of the dataset, where it has such."""
    if not isinstance(model, BodyModel):
        count = (
            data.known.pose.shape[1]
            if data.known is not None and data.known.pose is not None
            else 0
        )
        joints = {len(layout.joint_names): name for name, layout in LAYOUTS.items()}.get(count)
        body = load_body(str(model), joints=joints)
        fine = body.num_vertices != data.num_vertices and has_levels(str(model))
        return load_body(str(model), detail="full", joints=joints) if fine else body
    return model
