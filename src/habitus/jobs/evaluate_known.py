"""Bodies against registrations whose poses and people are known, without fits: ``habitus evaluate
--known``.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from habitus.body.joint_layouts import LAYOUTS
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.known_state import KnownErrors, known_errors
from habitus.evaluate.posable import without_pose_shapes
from habitus.files import atomic_write, writable_folder
from habitus.io.models.bodies import load_body
from habitus.io.models.levels import has_levels
from habitus.io.registrations.open import open_registrations
from habitus.jobs.evaluation_models import model_names
from habitus.mesh.registrations import Registrations
from habitus.parallel.choose import WorkersLike, open_workers
from habitus.parallel.workers import ReportingWorkers
from habitus.types import PathLike, Progress

WHO = ("all", "new people", "known people")


@dataclass(frozen=True, eq=False)
class KnownEvaluation:
    """For each model and group of people (`WHO`, those there are) mean, rms and p95 of vertex
    distance (m), and the share of the first model's plain LBS error (mean) that is gone.
    """

    models: Mapping[str, Mapping[str, Mapping[str, float]]]
    registrations: int
    errors: Mapping[str, KnownErrors]


def evaluate_known(
    models: Sequence[PathLike | BodyModel],
    dataset: PathLike | Sequence[PathLike] | Registrations,
    out: PathLike | None = None,
    *,
    split: str = "test",
    sex: str | None = None,
    unit: str = "m",
    workers: WorkersLike = None,
    progress: Progress | None = None,
) -> KnownEvaluation:
    """Errors of body models in the poses and shapes that the registrations of the set ``split``
    tell.

    The first model is also measured as plain LBS and plain DQBS, without its pose blend shapes. Of
    a body of two levels of detail the one is taken that the dataset is of. New people are those of
    whom the dataset has no registration in another set. ``out`` receives known.json. Raises
    HabitusError for bad input.
    """
    if not models:
        raise HabitusError("no model was given; expected one or more model files, or 'default'")
    everything = (
        dataset if isinstance(dataset, Registrations) else open_registrations(dataset, unit=unit)
    )
    data = everything.where(set=split, sex=sex)
    if not len(data):
        raise HabitusError(
            f"the dataset has no registrations of the set {split!r}; choose another with --split"
        )
    bodies = _bodies(models, data)
    with open_workers(workers) as ready:
        report = ReportingWorkers(
            ready, lambda done, total: (progress or _nothing)("known poses", done / total)
        )
        errors = known_errors(bodies, data, report)
    others = {
        one for one, where in zip(everything.subject, everything.set, strict=True) if where != split
    }
    known = np.array([one in others for one in data.subject])
    groups = {
        name: rows
        for name, rows in zip(WHO, (known | ~known, ~known, known), strict=True)
        if rows.any()
    }
    plain = next(iter(errors))
    found = {
        name: {
            who: {
                **one.over(rows),
                "removed": 1 - one.over(rows)["mean"] / errors[plain].over(rows)["mean"],
            }
            for who, rows in groups.items()
        }
        for name, one in errors.items()
    }
    evaluation = KnownEvaluation(found, len(data), errors)
    if out is not None:
        with atomic_write(writable_folder(Path(out)) / "known.json") as temporary:
            told = {"registrations": len(data), "set": split, "metres": found}
            temporary.write_text(json.dumps(told, indent=1, ensure_ascii=False), encoding="utf-8")
    return evaluation


def _nothing(stage: str, share: float) -> None:
    """Whom nobody listens to."""


def _bodies(models: Sequence[PathLike | BodyModel], data: Registrations) -> dict[str, BodyModel]:
    """Plain LBS and DQBS of the first model, then all as they are."""
    loaded = [_body(model, data) for model in models]
    plain = replace(without_pose_shapes(loaded[0]), pose_joints=None)
    found = {
        "plain LBS": replace(plain, skinning="lbs"),
        "plain DQBS": replace(plain, skinning="dqbs"),
    }
    return found | dict(zip(model_names(models), loaded, strict=True))


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
