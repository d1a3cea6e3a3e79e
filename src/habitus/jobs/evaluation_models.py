"""Models to evaluate: loaded from files, given unique names; variances of their shape spaces."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.posable import ComparedModel, PosableBody, without_pose_shapes
from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import body_template
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.types import PathLike


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
    found = []
    for given, name in zip(models, model_names(models), strict=True):
        model = _load(given, name)
        file = str(given) if isinstance(given, (str, os.PathLike)) else None
        found.append(Loaded(model, file))
        if plain and isinstance(model, PosableBody) and model.body.posedirs is not None:
            body = without_pose_shapes(model.body)
            found.append(Loaded(PosableBody(body, f"{name}, plain"), file, name))
    return found


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
