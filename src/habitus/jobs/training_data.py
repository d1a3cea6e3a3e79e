"""Data and results of a training: registrations and template opened and checked; the trained models
written.
"""

import json
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import habitus
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export.trained_body import write_model, write_poses
from habitus.files import atomic_write, writable_folder
from habitus.io.models.levels import has_levels
from habitus.io.registrations.open import open_registrations
from habitus.io.registrations.templates import body_template, template_and_body
from habitus.learn.checks import check_registrations, refuse
from habitus.learn.options import TrainOptions
from habitus.learn.train import TrainedBody
from habitus.mesh.mirror import with_mirror
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import ReportingWorkers, Workers
from habitus.types import PathLike, Progress

SEXES = ("all", "each", "female", "male")
MAX_NAMED = 5
"""Registrations that a warning names."""


def open_training_data(
    datasets: PathLike | Sequence[PathLike] | Registrations,
    unit: str,
    every: int,
    sex: str,
    include_failed: bool = False,
) -> tuple[Registrations, list[str]]:
    """The registrations to train on, those of the sets "pose" and "shape" and the sex asked for;
    and warnings.

    Registrations that `habitus register` judged failed are left out unless ``include_failed``.
    """
    if sex not in SEXES:
        raise HabitusError(f"sex is {sex!r}; expected one of {', '.join(SEXES)}")
    if not isinstance(datasets, Registrations):
        paths = [datasets] if isinstance(datasets, str | os.PathLike) else list(datasets)
        datasets = open_registrations(
            [Path(path).absolute() for path in paths], unit=unit, every=every
        )
    data = datasets.where(set=("pose", "shape"))
    warnings = []
    if data.failed.any() and not include_failed:
        names = [data.name[k] for k in np.flatnonzero(data.failed)]
        if len(names) == len(data):
            raise HabitusError(
                f"all {len(names)} registrations were judged failed; look at their reports, or "
                "train with include_failed"
            )
        shown_names = ", ".join(names[:MAX_NAMED]) + (", …" if len(names) > MAX_NAMED else "")
        warnings.append(
            f"{len(names)} of {len(data)} registrations were judged failed and are left out: "
            f"{shown_names}; --include-failed takes them"
        )
        data = data.take(np.flatnonzero(~data.failed))
    if sex == "all":
        return data, warnings
    wanted = ("female", "male") if sex == "each" else (sex,)
    known = data.where(sex=wanted)
    if not len(known):
        raise HabitusError(
            f"no registration is said to be {' or '.join(wanted)}; tell their sex, or train --sex "
            "all"
        )
    unknown = len(data.where(sex=""))
    if unknown:
        warnings.append(f"{unknown} registrations of unknown sex are left out")
    return known, warnings


def by_sex(data: Registrations, sex: str) -> dict[str, Registrations]:
    """The registrations of each model by sex; "" means all people together."""
    known = {word: data.where(sex=word) for word in ("female", "male") if word in data.sex}
    groups = {"": data} if sex == "all" else known
    for word, group in groups.items():
        if "pose" not in group.set:
            raise HabitusError(
                f"no {word or 'single'} registration belongs to the set 'pose'; expected several "
                "poses each of several "
                "people"
            )
    return groups


def check_people(sex: str, data: Registrations, options: TrainOptions) -> None:
    """Refuse too few people before hours are spent on their poses."""
    people = data.set.count("shape") or len(data.subjects)
    least = max(2, options.shape_features + 1)
    if people < least:
        raise HabitusError(
            f"too few {sex or 'people'} to learn shapes from: {people}, with "
            f"{options.shape_features} "
            f"shape_features; expected {least} or more"
        )


def open_template(
    template: PathLike | Template | BodyModel,
    options: TrainOptions,
    detail: str = "coarse",
    joints: str | None = None,
) -> tuple[Template, BodyModel | None, list[str]]:
    """The template with its mirror, the body that it is of (None: of none), and a warning where it
    has no mirror.
    """
    if isinstance(template, Template):
        found = template
        body = None
    elif isinstance(template, BodyModel):
        found = body_template(template)
        body = template
    else:
        found, body = template_and_body(str(template), detail=detail, joints=joints)
    if options.start == "body" and body is None:
        raise HabitusError(
            "start 'body' with a template that is of no body model; expected a body's file, or "
            "'default'"
        )
    try:
        return with_mirror(found), body, []
    except HabitusError as error:
        return (
            found,
            body,
            [f"the template is not symmetric: {error}; nothing holds left and right together"],
        )


def two_levels(template: PathLike | Template | BodyModel, detail: str) -> str | None:
    """The name or file of the body whose full level is trained, where there is a coarse one beside
    it.
    """
    if (
        detail != "full"
        or isinstance(template, Template | BodyModel)
        or not has_levels(str(template))
    ):
        return None
    return str(template)


def check_data(
    data: Registrations, template: Template, workers: Workers, progress: Progress
) -> list[str]:
    """The warnings about the registrations. Raises HabitusError where there are errors."""
    reporting = ReportingWorkers(
        workers, lambda done, total: progress("check registrations", done / total)
    )
    findings = check_registrations(
        data, template, over=lambda function, rows: reporting.map(_call, function, list(rows))
    )
    refuse(findings)
    return [str(finding) for finding in findings]


def _call(function: Callable, item: int) -> Any:
    return function(item)


@dataclass(frozen=True, eq=False)
class Training:
    """One trained model with its energies, estimate, warnings and seconds of work.

    ``sex`` is "female", "male" or "" (a model of all people). ``folder`` is where the files are,
    None where nothing was written. ``step_seconds`` holds for each model the seconds of work at the
    end of each step of its history. ``baselines`` are the models without pose blend shapes, by
    name. ``like`` is the body's file of two levels of detail whose full one was trained, where it
    was.
    """

    sex: str
    trained: TrainedBody
    registrations: Registrations
    options: TrainOptions
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]
    step_seconds: Mapping[str, Sequence[float]]
    folder: Path | None = None
    baselines: Mapping[str, TrainedBody] = field(default_factory=dict)
    like: str | None = None

    @property
    def body(self) -> BodyModel:
        """The trained body model."""
        return self.trained.body

    def save(self, folder: PathLike) -> "Training":
        """Write model.npz, model.pkl, poses.npz, training.json and the baselines' models, each
        atomically.

        The same result is returned with its folder, and with a warning where SMPL's pickle cannot
        express the model (no model.pkl is written then). Raises HabitusError where the folder
        cannot be written to.
        """
        folder = writable_folder(Path(folder))
        notes = write_model(self.body, folder, like=self.like)
        write_poses(
            folder / "poses.npz", self.registrations.where(set="pose"), self.trained.estimate
        )
        for name, baseline in self.baselines.items():
            write_model(baseline.body, folder, name)
        warnings = (*self.warnings, *(note for note in notes if note not in self.warnings))
        saved = replace(self, folder=folder, warnings=warnings)
        write_record(saved, folder)
        return saved


def write_record(done: Training, folder: Path) -> None:
    """training.json: version, sizes, options, energies of every step, seconds, variances along the
    shape directions.
    """
    body = done.body
    sets = Counter(done.registrations.set)
    seconds = done.step_seconds
    record = {
        "version": habitus.__version__,
        "sex": done.sex,
        "sizes": {
            "vertices": body.num_vertices,
            "faces": body.num_faces,
            "joints": body.num_joints,
            "betas": body.num_betas,
            "pose_registrations": sets["pose"],
            "pose_subjects": len(done.registrations.where(set="pose").subjects),
            "shape_registrations": sets["shape"],
        },
        "options": asdict(done.options),
        "warnings": list(done.warnings),
        "seconds": dict(done.seconds),
        **_history(done.trained, seconds["model"]),
        "baselines": {name: _history(one, seconds[name]) for name, one in done.baselines.items()},
    }
    with atomic_write(folder / "training.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False), encoding="utf-8")


def _history(trained: TrainedBody, seconds: Sequence[float]) -> dict[str, Any]:
    energies = [
        {
            "round": r.round,
            "step": r.step,
            "total": r.energy.total,
            "terms": dict(r.energy.terms),
            "seconds": at,
        }
        for r, at in zip(trained.history, seconds, strict=True)
    ]
    return {"energies": energies, "shape_variances": trained.shape.variances.tolist()}
