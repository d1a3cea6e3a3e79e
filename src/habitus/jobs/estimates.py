"""Bodies of people of whom only some measurements are known."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.surface_files import write_surface
from habitus.errors import HabitusError
from habitus.export.npz import shape_arrays, write_arrays
from habitus.fit.from_measurements import (
    ESTIMATE,
    BodyEstimate,
    EstimateSettings,
    Given,
    estimate_body,
)
from habitus.io.measurement_files import read_measurements
from habitus.io.models.bodies import load_body
from habitus.types import PathLike

FROM_FILE = replace(ESTIMATE, precision=0.003, robust=5.0)
"""Settings for files of measurements, which were taken by hand and by other definitions."""
_SAID = 8
SEXES = ("neutral", "female", "male")


def body_from_measurements(
    *,
    sex: str = "neutral",
    age: float | None = None,
    body: PathLike | BodyModel | None = None,
    settings: EstimateSettings = ESTIMATE,
    **measurements: Given,
) -> BodyEstimate:
    """The likeliest person with some measurements: ``body_from_measurements(height=1.78, weight=80,
    sex="male")``.

    Any of the measurements that bodies have (m, kg; `habitus.body.measurement_names`), under their
    names or short ones (height, weight, chest, waist, hip, inseam, …), each a number or (number,
    its standard deviation). sex: "female", "male" or "neutral" picks the shape space; ``body``
    another one. age in years, where the body has ages. The result knows its ``betas``,
    ``measurements``, and the ``spread`` of what was not given; ``settings`` holds tuning numbers.
    Raises HabitusError for names and values that make no sense, and for people such as nobody is
    (1.78 m, 20 kg).
    """
    if sex not in SEXES:
        raise HabitusError(f"sex is {sex!r}; expected one of {', '.join(SEXES)}")
    if isinstance(body, BodyModel):
        model = body
    else:
        model = load_body(
            os.fspath(body) if body is not None else "default" if sex == "neutral" else sex
        )
    if age is None:
        return estimate_body(model, measurements, settings)
    estimate = estimate_body(model.at_age(age), measurements, settings)
    return replace(estimate, space=model.name, age=float(age))


def measurements_of(path: PathLike, sex: str = "") -> tuple[dict[str, Given], tuple[str, ...]]:
    """The measurements in a file (`habitus.io.measurement_files`), and what must be known of them.

    sex: of the shape space that they are meant for.
    """
    found = read_measurements(path)
    notes = []
    if found.unused:
        more = "" if len(found.unused) <= _SAID else f" and {len(found.unused) - _SAID} more"
        notes.append(f"{found.program}: not used: {', '.join(found.unused[:_SAID])}{more}")
    if found.sex and sex not in ("", found.sex):
        notes.append(f"the file says {found.sex}, the body is {sex}; --sex {found.sex} follows it")
    return dict(found.values), tuple(notes)


def save_estimate(estimate: BodyEstimate, path: PathLike) -> None:
    """Write the person as a mesh at rest (.ply, .obj, .glb), or as an .npz that `habitus measure`
    reads.

    A mesh is of the full level of detail. The npz holds ``betas``, ``betas_covariance``,
    ``gender``, ``surface_model_type``, with an age ``age_years``, and names, values and spreads of
    the measurements. Raises HabitusError for another ending, or where nothing can be written.
    """
    target = Path(path)
    if target.suffix.lower() != ".npz":
        write_surface((estimate.body.full or estimate.body)(estimate.betas), target)
        return
    write_arrays(target, _arrays(estimate))


def _arrays(estimate: BodyEstimate) -> Mapping[str, np.ndarray]:
    gender = estimate.space if estimate.space in SEXES else "neutral"
    return shape_arrays(estimate.body, estimate.betas, estimate.space, gender) | {
        "betas_covariance": estimate.covariance,
        "measurement_names": np.array(list(estimate.measurements)),
        "measurements": np.array(list(estimate.measurements.values())),
        "measurement_spread": np.array(list(estimate.spread.values())),
    }
