"""Models to be evaluated: from files, by names that tell them apart, and what their shapes vary by."""

import json
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.evaluate.posable import PosableBody, without_pose_shapes
from habitus.evaluate.result import Model
from habitus.io.models.blendscape import load_blendscape
from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import body_template
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.types import PathLike


@dataclass(frozen=True, eq=False)
class Loaded:
    """A model, the file it is from, and the name of the model that it is without its pose blend shapes."""

    model: Model
    file: str
    twin: str | None = None


def load_models(paths: Sequence[PathLike], plain: bool) -> list[Loaded]:
    """The models of files (or "default"), each with ``plain`` once more without its pose blend shapes.

    Raises HabitusError for files that are none, or given twice.
    """
    found = []
    for path, name in zip(paths, _names(paths), strict=True):
        model = _load(path, name)
        found.append(Loaded(model, str(path)))
        if plain and isinstance(model, PosableBody) and model.body.posedirs is not None:
            body = without_pose_shapes(model.body)
            found.append(Loaded(PosableBody(body, f"{name}, plain"), str(path), name))
    return found


def rest_template(model: Model) -> Template:
    """The model at rest, cut by strongest joints: what registrations are checked against."""
    if isinstance(model, PosableBody):
        return body_template(model.body)
    names = tuple(f"joint {k}" for k in range(len(model.parents)))
    return Template(model.template, model.faces, model.influence.argmax(1), model.parents, names)


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


def check_topology(model: Model, registrations: Registrations, dataset: PathLike) -> None:
    """Raise HabitusError unless a model has the registrations' vertices and faces."""
    faces = model.body.faces if isinstance(model, PosableBody) else model.faces
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


def shape_variances(model: Model, file: str) -> tuple[Float[np.ndarray, " S"], bool]:
    """Variances along shape directions, and whether these are all that the model was trained on.

    They are kept with the model or in the training.json beside it; else they are those of the model's own directions,
    which are scaled to one standard deviation.
    """
    if isinstance(model, PosableBody):
        kept, directions = model.body.extras.get("shape_variances"), model.body.shapedirs.reshape(-1, model.num_betas).T
        kept = _told_by_training(Path(file)) if kept is None else kept
    else:
        kept, directions = model.shape_variances, model.shape_directions.reshape(model.num_betas, -1)
    if kept is not None:
        return np.asarray(kept, float).reshape(-1), True
    return (np.asarray(directions) ** 2).sum(1), False


def _told_by_training(file: Path) -> list[float] | None:
    """As `habitus train` wrote them for this file."""
    try:
        record = json.loads((file.parent / "training.json").read_text("utf-8"))
        return (record if file.stem == "model" else record["baselines"][file.stem])["shape_variances"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
