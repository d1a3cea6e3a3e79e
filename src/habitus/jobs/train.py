"""From registrations to a trained body model: registrations and template opened and checked, the
models trained and written. ``habitus train`` calls `train`.
"""

import json
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import habitus
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export.trained_body import write_model, write_poses
from habitus.files import atomic_write, files_together, locked, tidy, writable_folder
from habitus.io.models.levels import has_levels
from habitus.io.registrations.open import open_registrations
from habitus.io.registrations.templates import body_template, template_and_body
from habitus.jobs.checkpoints import Callbacks, Checkpoint, CheckpointingCallback, fingerprint
from habitus.jobs.learn_options import TrainingOptions
from habitus.jobs.options import takes
from habitus.learn.callback import Record
from habitus.learn.check_settings import CheckSettings
from habitus.learn.checks import check_registrations, refuse
from habitus.learn.options import TrainOptions
from habitus.learn.train import TrainedBody, train_body
from habitus.mesh.mirror import with_mirror
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import (
    ReportingWorkers,
    Workers,
    WorkersLike,
    open_workers,
    pickled_size,
)
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
    sexes = ("female", "male") if sex == "each" else (sex,)
    known = data.where(sex=sexes)
    if not len(known):
        raise HabitusError(
            f"no registration has the sex {' or '.join(sexes)}; give it, or train with --sex all"
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
        opened = template
        body = None
    elif isinstance(template, BodyModel):
        opened = body_template(template)
        body = template
    else:
        opened, body = template_and_body(str(template), detail=detail, joints=joints)
    if options.start == "body" and body is None:
        raise HabitusError(
            "start 'body' with a template that is of no body model; expected a body's file, or "
            "'default'"
        )
    try:
        return with_mirror(opened), body, []
    except HabitusError as error:
        return (
            opened,
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
    data: Registrations,
    template: Template,
    workers: Workers,
    progress: Progress,
    settings: CheckSettings,
) -> list[str]:
    """The warnings about the registrations. Raises HabitusError where there are errors."""
    reporting = ReportingWorkers(
        workers, lambda done, total: progress("check registrations", done / total)
    )
    findings = check_registrations(
        data,
        template,
        over=lambda function, rows: reporting.map(_call, function, list(rows)),
        settings=settings,
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
        """Write model.npz, model.pkl, poses.npz, training.json and the baselines' models, all or
        none.

        The same result is returned with its folder, and with a warning where SMPL's pickle cannot
        express the model (no model.pkl is written then). Raises HabitusError where the folder
        cannot be written to.
        """
        folder = writable_folder(Path(folder))
        with files_together(folder, ours=("model.pkl",)) as partial:
            notes = write_model(self.body, partial, like=self.like)
            poses = self.registrations.where(set="pose")
            write_poses(partial / "poses.npz", poses, self.trained.estimate)
            for name, baseline in self.baselines.items():
                write_model(baseline.body, partial, name)
            warnings = (*self.warnings, *(note for note in notes if note not in self.warnings))
            saved = replace(self, folder=folder, warnings=warnings)
            write_record(saved, partial)
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
        "baselines": {
            name: _history(baseline, seconds[name]) for name, baseline in done.baselines.items()
        },
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


_BASELINES = {"plain-lbs": "lbs", "plain-dqbs": "dqbs"}
_NO_POSE_SHAPES = {"pose_shapes": "none", "pose_features": "rotations", "shape_features": 0}
_MUCH = 1e9  # bytes of vertices sent to a cluster's machines again and again


@dataclass(frozen=True)
class Trainer(TrainingOptions):
    """Training of body models from registrations (S 4, T 5.4); its keyword arguments are the
    options of `habitus train`.

        model = Trainer(skinning="lbs", num_betas=20).fit("people.npz", template="template.npz")
        model.body, model.save("trained")

    Raises HabitusError for options that do not make sense.
    """

    def fit(
        self,
        registrations: PathLike | Sequence[PathLike] | Registrations,
        template: PathLike | Template | BodyModel | None = None,
        *,
        out: PathLike | None = None,
        restart: bool = False,
        workers: WorkersLike = None,
        progress: Progress | None = None,
        on_step: Callable[[str, Record], None] | None = None,
        on_warning: Callable[[str], None] | None = None,
    ) -> Training:
        """Train one model. Without ``out`` nothing is written; with it, files and checkpoints as
        `train` writes them.

        Arguments are those of `train`; ``sex`` "each", which means two models, is refused.
        """
        if self.sex == "each":
            raise HabitusError(
                "sex 'each' means two models; fit 'female' and 'male' in turn, or use habitus.train"
            )
        options = self if template is None else replace(self, template=template)
        callbacks = Callbacks.of(progress, on_step, on_warning)
        folder = None if out is None else Path(out)
        (done,) = _train(registrations, folder, options, workers, callbacks, restart)
        return done


@takes(TrainingOptions)
def train(
    datasets: PathLike | Sequence[PathLike] | Registrations,
    out: PathLike,
    *,
    options: TrainingOptions,
    restart: bool = False,
    workers: WorkersLike = None,
    progress: Progress | None = None,
    on_step: Callable[[str, Record], None] | None = None,
    on_warning: Callable[[str], None] | None = None,
) -> list[Training]:
    """Train body models from registrations and write them to the folder ``out``; one model for each
    sex with ``sex`` "each".

    datasets: what `open_registrations` opens, in one topology; or registrations already open (m).
    template: what `load_template` loads, or a BodyModel: its landmarks, pose prior and sex are
    carried over. ``sex`` "each", "female" and "male" use folders of those names in ``out``.
    workers: number of threads (default: one per core), address of a Dask scheduler, or Workers.
    progress: (stage, share done). on_step: (model, record), the energy after each step. on_warning:
    (text).

    A stopped run continues when called again with the same arguments, a finished one when called
    with more rounds; ``restart`` discards its checkpoint. Raises HabitusError, in one line, for bad
    input and for faulty registrations, which it names.
    """
    callbacks = Callbacks.of(progress, on_step, on_warning)
    return _train(datasets, Path(out), options, workers, callbacks, restart)


@dataclass(frozen=True, eq=False)
class _Run:
    """Shared by all models of a run; ``out`` is None where nothing is written."""

    out: Path | None
    template: Template
    body: BodyModel | None
    options: TrainOptions
    baselines: bool
    workers: Workers
    callbacks: Callbacks
    restart: bool
    notes: tuple[str, ...]
    like: str | None


def _train(
    datasets: PathLike | Sequence[PathLike] | Registrations,
    out: Path | None,
    options: TrainingOptions,
    workers: WorkersLike,
    callbacks: Callbacks,
    restart: bool,
) -> list[Training]:
    data, notes = open_training_data(
        datasets, options.unit, options.every, options.sex, options.include_failed
    )
    groups = by_sex(data, options.sex)
    for whose, group in groups.items():
        check_people(whose, group, options)
    model, body, about = open_template(options.template, options, options.detail, options.joints)
    notes += about
    with open_workers(workers) as ready:
        if isinstance(workers, str) and (size := pickled_size(data.vertices)) > _MUCH:
            notes.append(
                f"{size / 1e9:.1f} GB of vertices are sent to the cluster's machines again and "
                "again; registrations in "
                "a folder that all of them see are read there"
            )
        notes += check_data(data, model, ready, callbacks.progress, options.settings.checks)
        for note in notes:
            callbacks.on_warning(note)
        like = two_levels(options.template, options.detail)
        run = _Run(
            out,
            model,
            body,
            options.training,
            options.baselines,
            ready,
            callbacks,
            restart,
            tuple(notes),
            like,
        )
        with nullcontext() if out is None else locked(out):
            return [_train_one(run, whose, group) for whose, group in groups.items()]


def _train_one(run: _Run, sex: str, data: Registrations) -> Training:
    folder = None if run.out is None else run.out / sex
    if folder is not None:
        tidy(folder)
    done = _train_model(
        run, folder, sex, replace(data, faces=run.template.faces)
    )  # same faces, other order
    return _train_baselines(run, folder, done) if run.baselines else done


def _train_model(run: _Run, folder: Path | None, sex: str, data: Registrations) -> Training:
    """The model itself, written where there is a folder."""
    trained, callback = _train_body(run, folder, sex, data, "model", run.options)
    late = _fewer_betas(trained, run.options)
    seconds = {"model": callback.elapsed}
    steps = {"model": callback.seconds}
    done = Training(
        sex, trained, data, run.options, (*run.notes, *late), seconds, steps, like=run.like
    )
    if folder is not None:
        done = done.save(folder)
    for note in done.warnings[len(run.notes) :]:
        run.callbacks.on_warning(f"{sex} {note}".strip())
    return done


def _train_baselines(run: _Run, folder: Path | None, done: Training) -> Training:
    """The same registrations without pose blend shapes, linear and dual quaternion (S 5.1)."""
    for name, skinning in _BASELINES.items():
        fixed = tuple(name for name in run.options.fixed if name != "posedirs")
        options = replace(run.options, **_NO_POSE_SHAPES, skinning=skinning, fixed=fixed)
        trained, callback = _train_body(run, folder, done.sex, done.registrations, name, options)
        done = replace(
            done,
            baselines={**done.baselines, name: trained},
            seconds={**done.seconds, name: callback.elapsed},
            step_seconds={**done.step_seconds, name: callback.seconds},
        )
    return done if folder is None else done.save(folder)


def _fewer_betas(trained: TrainedBody, options: TrainOptions) -> list[str]:
    count = trained.body.num_betas
    if count == options.num_betas or "shapedirs" in options.fixed:
        return []
    return [f"shape directions: {count}, not {options.num_betas}; the people vary along no more"]


def _train_body(
    run: _Run,
    folder: Path | None,
    sex: str,
    data: Registrations,
    name: str,
    options: TrainOptions,
) -> tuple[TrainedBody, CheckpointingCallback]:
    """Train one body, from its checkpoint where there is one."""
    checkpoint = None
    if folder is not None:
        described = fingerprint(data, run.template, options, run.body)
        checkpoint = Checkpoint.open(folder / "checkpoint" / name, described, restart=run.restart)
    title = f"{sex} {name}".strip()
    callback = CheckpointingCallback(
        title, checkpoint, options.rounds, run.callbacks.progress, run.callbacks.on_step
    )
    workers = ReportingWorkers(run.workers, callback.on_item)
    trained = train_body(
        data,
        run.template,
        options,
        body=run.body,
        workers=workers,
        callback=callback,
        resume=callback.state,
        name=title,
    )
    return trained, callback
