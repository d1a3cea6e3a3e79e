"""From registrations to a trained body model: open, check, train, write. ``habitus train`` calls
`train`.
"""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.files import locked, tidy
from habitus.jobs.checkpoints import Callbacks, Checkpoint, CheckpointingCallback, fingerprint
from habitus.jobs.learn_options import TrainingOptions
from habitus.jobs.options import takes
from habitus.jobs.training_data import (
    Training,
    by_sex,
    check_data,
    check_people,
    open_template,
    open_training_data,
    two_levels,
)
from habitus.learn.callback import Record
from habitus.learn.options import TrainOptions
from habitus.learn.train import TrainedBody, train_body
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
        notes += check_data(data, model, ready, callbacks.progress)
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
    found = trained.body.num_betas
    if found == options.num_betas or "shapedirs" in options.fixed:
        return []
    return [f"shape directions: {found}, not {options.num_betas}; the people vary along no more"]


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
