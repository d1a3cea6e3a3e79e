"""From trained models and held-out registrations to the figures of the papers: read, fit, time, write (S 5).

`habitus evaluate` calls this.
"""

import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.io.blendscape import load_blendscape
from habitus.io.models import load_body
from habitus.io.registrations import open_registrations
from habitus.learn.blendscape import BlendScape
from habitus.learn.generalisation import COUNTS, Generalisation, model_generalisation, pose_generalisation
from habitus.learn.neck_twist import NeckTwist, neck_twist, twist_joints
from habitus.learn.posable import PosableBody, without_pose_shapes
from habitus.learn.registrations import Registrations, Vertices
from habitus.learn.timing import ForwardTimes, time_forward
from habitus.learn.workers import Threads, Workers

PathLike = str | os.PathLike[str]
Progress = Callable[[str, float], None]
Model = PosableBody | BlendScape


@dataclass(frozen=True, eq=False)
class ModelEvaluation:
    """One model's measures; ``twin`` names the model that it is without its pose blend shapes.

    ``variances`` (m^2, or of triangle deformations) are those of the shapes that it was trained on where the file
    keeps them (``all_variances``), else those that its own directions explain.
    """

    model: Model
    file: str
    twin: str | None
    shape: Generalisation
    pose: Generalisation | None
    times: ForwardTimes
    variances: Float[np.ndarray, " S"]
    all_variances: bool
    twist: NeckTwist | None

    @property
    def name(self) -> str:
        """What tables and figures call it."""
        return self.model.name


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Models measured on the same registrations; ``clean`` are these without noise, where they are known."""

    dataset: str
    registrations: Registrations
    clean: Vertices | None
    models: tuple[ModelEvaluation, ...]

    @property
    def shown(self) -> int | None:
        """The largest number of shape coefficients that all models were measured with; None where there is none."""
        common = set.intersection(*({*entry.shape.counts} for entry in self.models))
        return max(common, default=None)


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
    loaded = _loaded(models, plain)
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
        _check_topology(one.model, registrations, dataset)
    if out is not None:
        from habitus.evaluation_files import prepare_folder  # complains before hours of fits, not after

        prepare_folder(Path(out))
    found = _measured(
        loaded, registrations, counts, true, repeats, workers or Threads(len(os.sched_getaffinity(0))), progress
    )
    evaluation = Evaluation(str(dataset), registrations, true, found)
    if out is not None:
        from habitus.evaluation_files import write_evaluation

        progress("write", 1.0)
        write_evaluation(evaluation, Path(out))
    return evaluation


# -- models -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Loaded:
    model: Model
    file: str
    twin: str | None = None


def _loaded(paths: Sequence[PathLike], plain: bool) -> list[_Loaded]:
    found = []
    for path, name in zip(paths, _names(paths), strict=True):
        model = _load(path, name)
        found.append(_Loaded(model, str(path)))
        if plain and isinstance(model, PosableBody) and model.body.posedirs is not None:
            body = without_pose_shapes(model.body)
            found.append(_Loaded(PosableBody(body, f"{name}, plain"), str(path), name))
    return found


def _names(paths: Sequence[PathLike]) -> list[str]:
    """The files' names, that of its folder for a model.npz, and both where one alone does not tell files apart."""
    stems = [_stem(Path(path)) for path in paths]
    names = [
        stem if stems.count(stem) == 1 else f"{Path(path).resolve().parent.name}/{Path(path).stem}"
        for stem, path in zip(stems, paths, strict=True)
    ]
    for name, path in zip(names, paths, strict=True):
        if names.count(name) > 1:
            raise HabitusError(f"two models are called {name} ({path}); expected names that differ: rename one")
    return names


def _stem(path: Path) -> str:
    return path.resolve().parent.name if path.stem == "model" else path.stem


def _load(path: PathLike, name: str) -> Model:
    if _is_blendscape(path):
        return replace(load_blendscape(path), name=name)
    body = load_body(os.fspath(path))
    return PosableBody(replace(body, name=name), name)


def _is_blendscape(path: PathLike) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "pose_regression.npy" in archive.namelist()


def _check_topology(model: Model, registrations: Registrations, dataset: PathLike) -> None:
    faces = model.body.faces.numpy() if isinstance(model, PosableBody) else model.faces
    count = model.body.num_vertices if isinstance(model, PosableBody) else len(model.template)
    if count != registrations.num_vertices or not _same_faces(faces, registrations.faces):
        raise HabitusError(
            f"{model.name} has {count} vertices and {len(faces)} faces, another topology than {dataset} with "
            f"{registrations.num_vertices} and {len(registrations.faces)}; expected a model trained on such meshes"
        )


def _same_faces(one: np.ndarray, other: np.ndarray) -> bool:
    sides = [np.sort(np.asarray(faces, np.int64), axis=1) for faces in (one, other)]
    return one.shape == other.shape and all(
        np.array_equal(*(faces[np.lexsort(faces.T)][:, k] for faces in sides)) for k in range(3)
    )


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
    loaded: Sequence[_Loaded],
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
        ModelEvaluation(one.model, one.file, one.twin, *curves, times[one.model.name], *_variances(one.model), twist)
        for one, *curves, twist in zip(loaded, shapes, poses, twists, strict=True)
    )


def _times(loaded: Sequence[_Loaded], counts: Sequence[int], repeats: int) -> dict[str, ForwardTimes]:
    """Models with as many joints take turns."""
    by_joints: dict[int, list[Model]] = {}
    for one in loaded:
        by_joints.setdefault(len(one.model.parents), []).append(one.model)
    used = (0, *counts)
    found = (time_forward(group, used, joints=joints, repeats=repeats) for joints, group in by_joints.items())
    return {times.model: times for group in found for times in group}


def _twists(loaded: Sequence[_Loaded]) -> list[NeckTwist | None]:
    bodies = {one.model.name: one.model.body for one in loaded if isinstance(one.model, PosableBody)}
    necks = {name: body for name, body in bodies.items() if twist_joints(body.joint_names, body.parents)}
    found = dict(zip(necks, neck_twist([replace(body, name=name) for name, body in necks.items()]), strict=True))
    return [found.get(one.model.name) for one in loaded]


def _variances(model: Model) -> tuple[Float[np.ndarray, " S"], bool]:
    if isinstance(model, PosableBody):
        kept, directions = model.body.extras.get("shape_variances"), _directions(model.body)
    else:
        kept, directions = model.shape_variances, model.shape_directions.reshape(model.num_betas, -1)
    if kept is not None:
        return np.asarray(kept, float).reshape(-1), True
    return (directions**2).sum(1), False


def _directions(body: BodyModel) -> Float[np.ndarray, "B K"]:
    """Scaled to one standard deviation, so that their squared lengths are variances."""
    return body.shapedirs.double().flatten(0, 1).T.numpy()


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
