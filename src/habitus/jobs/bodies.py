"""Bodies of people of whom only some measurements are known."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from habitus.body.from_measurements import BodyEstimate, Given, estimate_body
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export.npz import save_arrays
from habitus.export.surface import write_surface
from habitus.io.files import atomic_write
from habitus.io.models.bodies import load_body
from habitus.types import PathLike

SEXES = ("neutral", "female", "male")
ADULT = (18.0, 30.0)
"""Years of age at which a body without ages is somebody's."""


def body_from_measurements(
    *, sex: str = "neutral", age: float | None = None, body: PathLike | BodyModel | None = None, **measurements: Given
) -> BodyEstimate:
    """The likeliest person with some measurements: ``body_from_measurements(height=1.78, weight=80, sex="male")``.

    Any of the measurements that bodies have (m, kg; `habitus.body.measurement_names`), under their names or short ones
    (height, weight, chest, waist, hip, inseam, …), each a number or (number, its standard deviation). sex: "female",
    "male" or "neutral" picks the shape space; ``body`` another one. age in years, where the body has ages. The result
    knows its ``betas``, ``measurements``, and the ``spread`` of what was not told.
    Raises HabitusError for names and values that make no sense, and for people such as nobody is (1.78 m, 20 kg).
    """
    if sex not in SEXES:
        raise HabitusError(f"sex is {sex!r}; expected one of {', '.join(SEXES)}")
    if isinstance(body, BodyModel):
        model = body
    else:
        model = load_body(os.fspath(body) if body is not None else "default" if sex == "neutral" else sex)
    if age is not None:
        model = _at_age(model, age)
    return estimate_body(model, measurements)


def _at_age(body: BodyModel, age: float) -> BodyModel:
    at_age = getattr(body, "at_age", None)
    if at_age is not None:
        return at_age(age)
    if not ADULT[0] <= age <= ADULT[1]:
        raise HabitusError(f"{body.name} has no ages, so age {age:g} means nothing to it; leave it out")
    return body


def save_estimate(found: BodyEstimate, path: PathLike, sex: str = "neutral") -> None:
    """Write the person as a mesh at rest (.ply, .obj, .glb), or as an .npz that `habitus measure` reads.

    The npz holds ``betas``, ``betas_covariance``, ``gender``, ``surface_model_type``, and names, values and spreads of
    the measurements. Raises HabitusError for another ending, or where nothing can be written.
    """
    target = Path(path)
    if target.suffix.lower() != ".npz":
        write_surface(found.body(found.betas), target)
        return
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        save_arrays(file, _arrays(found, sex))


def _arrays(found: BodyEstimate, sex: str) -> Mapping[str, np.ndarray]:
    return {
        "betas": found.betas,
        "betas_covariance": found.covariance,
        "gender": np.array(sex),
        "surface_model_type": np.array(found.body.name),
        "measurement_names": np.array(list(found.measurements)),
        "measurements": np.array(list(found.measurements.values())),
        "measurement_spread": np.array(list(found.spread.values())),
    }
