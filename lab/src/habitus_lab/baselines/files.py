"""Reads and writes BlendSCAPE models (`habitus_lab.baselines.blendscape`)."""

from dataclasses import fields
from pathlib import Path

import numpy as np

from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.io.limits import check_joints
from habitus.io.models.arrays import ModelArrays
from habitus.mesh.template import check_parents
from habitus_lab.baselines.blendscape import BlendScape

_PLAIN = ("name", "parents", "shape_variances")


def save_blendscape(model: BlendScape, path: str | Path) -> None:
    """Write a model as ``.npz`` under its fields' names, whole or not at all; the large tables in
    float32.

    Raises HabitusError for another ending or where nothing can be written.
    """
    target = Path(path)
    if target.suffix != ".npz":
        raise HabitusError(f"{target}: ending {target.suffix!r}; expected .npz")
    arrays = {
        item.name: np.asarray(getattr(model, item.name))
        for item in fields(model)
        if item.name not in _PLAIN
    }
    arrays |= {
        key: arrays[key].astype(np.float32) for key in ("shape_directions", "pose_regression")
    }
    arrays |= {"name": np.array(model.name), "parents": np.array(model.parents)}
    if model.shape_variances is not None:
        arrays["shape_variances"] = model.shape_variances
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_blendscape(path: str | Path) -> BlendScape:
    """The model in a file that `save_blendscape` wrote. Raises HabitusError, naming the file, where
    it is none.
    """
    source = Path(path)
    try:
        with source.open("rb") as file:
            return _model(ModelArrays(file))
    except HabitusError as error:
        raise HabitusError(f"{source}: {error}") from error
    except OSError as error:
        raise HabitusError(
            f"{source}: {error.strerror or error}; expected a BlendSCAPE model (.npz)"
        ) from error


def _model(arrays: ModelArrays) -> BlendScape:
    parents = tuple(int(parent) for parent in arrays.number("parents", None, dtype=np.int64))
    check_joints(len(parents))
    check_parents(parents)
    template = arrays.number("template", None, 3)
    v = len(template)
    j = len(parents)
    faces = arrays.index("faces", v, None, 3)
    f = len(faces)
    return BlendScape(
        name=arrays.text("name")[0],
        template=template,
        faces=faces,
        parents=parents,
        influence=arrays.number("influence", v, j),
        mean_shape=arrays.number("mean_shape", f, 3, 3),
        shape_directions=arrays.number("shape_directions", None, f, 3, 3),
        pose_regression=arrays.number("pose_regression", 9 * (j - 1), f, 3, 3),
        shape_variances=arrays.number("shape_variances", None)
        if "shape_variances" in arrays
        else None,
    )
