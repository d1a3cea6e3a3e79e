"""From registrations on disk to a body model on disk: open, check, learn, write. ``habitus train`` calls this."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from habitus.errors import HabitusError
from habitus.evaluate.baselines.blendscape import BlendScape
from habitus.evaluate.baselines.blendscape_training import train_blendscape
from habitus.export.trained_body import write_model, write_poses
from habitus.io.files import alone_in
from habitus.io.models.blendscape import save_blendscape
from habitus.io.registrations.open import open_registrations
from habitus.io.registrations.templates import load_template
from habitus.jobs.checkpoints import Checkpoint, fingerprint
from habitus.jobs.training_record import Training, write_record
from habitus.jobs.watch import Counted, Watch
from habitus.learn.checks import check_registrations, refuse
from habitus.learn.options import TrainOptions
from habitus.learn.train import Record, TrainedBody, poses_of, train_body
from habitus.mesh.mirror import with_mirror
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.cluster import connect, travelling_bytes
from habitus.parallel.workers import Threads, Workers
from habitus.types import PathLike

SEXES = ("all", "each", "female", "male")
_PLAIN = {"plain-lbs": "lbs", "plain-dqbs": "dqbs"}
_NO_POSE_SHAPES = {"pose_shapes": "none", "pose_features": "rotations", "shape_features": 0}
_MUCH = 1e9  # bytes of vertices sent to a cluster's machines again and again


@dataclass(frozen=True)
class Callbacks:
    """Who is told what while it happens: stages and their share done, energies of a model's steps, warnings."""

    progress: Callable[[str, float], None] = lambda stage, share: None
    recorded: Callable[[str, Record], None] = lambda model, record: None
    noted: Callable[[str], None] = lambda text: None


def train(
    datasets: PathLike | Sequence[PathLike] | Registrations,
    out: PathLike,
    *,
    template: PathLike | Template = "default",
    options: TrainOptions | None = None,
    sexes: str = "all",
    baselines: bool = False,
    cluster: str | None = None,
    threads: int | None = None,
    unit: str = "m",
    every: int = 1,
    restart: bool = False,
    callbacks: Callbacks | None = None,
) -> list[Training]:
    """Learn a body model from registrations, write it, and return it; with ``sexes`` "each" one for each sex.

    datasets: what `open_registrations` opens, in one topology; or registrations already open (m). template: what
    `load_template` loads. sexes: "all" together, "each", "female" or "male"; the latter three have folders of those
    names in ``out``. baselines: models without pose blend shapes and BlendSCAPE as well. cluster: the address of a Dask
    scheduler; else ``threads`` of this process (as many as there are cores). unit and every: see `open_registrations`.

    A run that was stopped goes on when called again the same way; ``restart`` begins anew. Raises HabitusError with one
    clear line for bad input, and for registrations in which something is wrong, by name.
    """
    callbacks = callbacks or Callbacks()
    data, notes = _opened(datasets, unit, every, sexes)
    options = options or TrainOptions()
    groups = _groups(data, sexes)
    for sex, group in groups.items():
        _check_people(sex, group, options)
    model, about = _template(template)
    notes += about
    with _workers(cluster, threads) as workers:
        if cluster is not None and (size := travelling_bytes(data.vertices)) > _MUCH:
            notes.append(
                f"{size / 1e9:.1f} GB of vertices are sent to the cluster's machines again and again; registrations in "
                "a folder that all of them see are read there"
            )
        notes += _checked(data, model, workers, callbacks)
        for note in notes:
            callbacks.noted(note)
        run = _Run(model, options, workers, callbacks, restart, tuple(notes))
        return [_train_one(run, Path(out) / sex, sex, one, baselines) for sex, one in groups.items()]


@dataclass(frozen=True, eq=False)
class _Run:
    """What all models of a run share."""

    template: Template
    options: TrainOptions
    workers: Workers
    callbacks: Callbacks
    restart: bool
    notes: tuple[str, ...]


def _opened(
    datasets: PathLike | Sequence[PathLike] | Registrations, unit: str, every: int, sexes: str
) -> tuple[Registrations, list[str]]:
    """The registrations that are learned from: of the sets "pose" and "shape", and the sexes asked for."""
    if sexes not in SEXES:
        raise HabitusError(f"sex is {sexes!r}; expected one of {', '.join(SEXES)}")
    if not isinstance(datasets, Registrations):
        paths = [datasets] if isinstance(datasets, str | os.PathLike) else list(datasets)
        datasets = open_registrations([Path(path).absolute() for path in paths], unit=unit, every=every)
    data = datasets.where(set=("pose", "shape"))
    if sexes == "all":
        return data, []
    wanted = ("female", "male") if sexes == "each" else (sexes,)
    told = data.where(sex=wanted)
    if not len(told):
        raise HabitusError(f"no registration is said to be {' or '.join(wanted)}; tell their sex, or train --sex all")
    untold = len(data.where(sex=""))
    return told, [f"{untold} registrations whose sex is not told are left out"] if untold else []


def _groups(data: Registrations, sexes: str) -> dict[str, Registrations]:
    """The registrations of each model, by sex; "" stands for all together."""
    told = {sex: data.where(sex=sex) for sex in ("female", "male") if sex in data.sex}
    groups = {"": data} if sexes == "all" else told
    for sex, one in groups.items():
        if "pose" not in one.set:
            raise HabitusError(
                f"no {sex or 'single'} registration belongs to the set 'pose'; expected several poses each of several "
                "people"
            )
    return groups


def _check_people(sex: str, data: Registrations, options: TrainOptions) -> None:
    """Complains of too few people before hours are spent on their poses."""
    people = data.set.count("shape") or len(data.subjects)
    least = max(2, options.shape_features + 1)
    if people < least:
        raise HabitusError(
            f"too few {sex or 'people'} to learn shapes from: {people}, with {options.shape_features} "
            f"shape_features; expected {least} or more"
        )


def _template(template: PathLike | Template) -> tuple[Template, list[str]]:
    """The template with its mirror, and a warning where it has none."""
    found = template if isinstance(template, Template) else load_template(str(template))
    try:
        return with_mirror(found), []
    except HabitusError as error:
        return found, [f"the template is not symmetric: {error}; nothing holds left and right together"]


@contextmanager
def _workers(cluster: str | None, threads: int | None) -> Iterator[Workers]:
    if cluster is not None:
        with connect(cluster) as workers:
            yield workers
        return
    count = len(os.sched_getaffinity(0)) if threads is None else threads
    if count < 1:
        raise HabitusError(f"{count} threads asked for; expected 1 or more")
    yield Threads(count)


def _checked(data: Registrations, template: Template, workers: Workers, callbacks: Callbacks) -> list[str]:
    """The warnings about the registrations. Raises HabitusError where there are errors."""
    counted = Counted(workers, lambda done, total: callbacks.progress("check registrations", done / total))
    findings = check_registrations(data, template, over=lambda function, rows: counted.map(_call, function, list(rows)))
    refuse(findings)
    return [str(finding) for finding in findings]


def _call(function: Callable, item: int) -> object:
    return function(item)


def _train_one(run: _Run, folder: Path, sex: str, data: Registrations, baselines: bool) -> Training:
    with alone_in(folder / "checkpoint"):
        return _train_alone(run, folder, sex, data, baselines)


def _train_alone(run: _Run, folder: Path, sex: str, data: Registrations, baselines: bool) -> Training:
    data = replace(data, faces=run.template.faces)  # the same, but for their order
    trained, watch = _watched(run, folder, sex, data, "model", run.options)
    late = [*_fewer_betas(trained, run.options), *write_model(trained.body, folder)]
    for note in late:
        run.callbacks.noted(f"{sex} {note}".strip())
    write_poses(folder / "poses.npz", data.where(set="pose"), trained.estimate)
    done = Training(sex, folder, trained, (*run.notes, *late), {"model": watch.elapsed})
    records = {"model": watch.seconds}
    write_record(done, data, run.options, records)
    if not baselines:
        return done
    for name, skinning in _PLAIN.items():
        options = replace(run.options, **_NO_POSE_SHAPES, skinning=skinning)
        plain, watch = _watched(run, folder, sex, data, name, options)
        write_model(plain.body, folder, name)
        done = replace(done, baselines={**done.baselines, name: plain}, seconds={**done.seconds, name: watch.elapsed})
        records[name] = watch.seconds
    began = time.perf_counter()
    scape = _blendscape(run, sex, data, trained)
    save_blendscape(scape, folder / "blendscape.npz")
    done = replace(done, blendscape=scape, seconds={**done.seconds, "blendscape": time.perf_counter() - began})
    write_record(done, data, run.options, records)
    return done


def _fewer_betas(trained: TrainedBody, options: TrainOptions) -> list[str]:
    found = trained.body.num_betas
    if found == options.num_betas:
        return []
    return [f"shape directions: {found}, not {options.num_betas}; the people vary along no more"]


def _watched(
    run: _Run, folder: Path, sex: str, data: Registrations, name: str, options: TrainOptions
) -> tuple[TrainedBody, Watch]:
    """Train, from where an earlier run came to."""
    checkpoint = Checkpoint.open(
        folder / "checkpoint" / name, fingerprint(data, run.template, options), restart=run.restart
    )
    title = f"{sex} {name}".strip()
    watch = Watch(title, checkpoint, options.rounds, run.callbacks.progress, run.callbacks.recorded)
    workers = Counted(run.workers, watch.counted)
    trained = train_body(data, run.template, options, workers=workers, watcher=watch, resume=watch.progress, name=title)
    return trained, watch


def _blendscape(run: _Run, sex: str, data: Registrations, trained: TrainedBody) -> BlendScape:
    """BlendSCAPE on the same registrations, in the poses that the trained model gave them."""
    title = f"{sex} BlendSCAPE".strip()
    workers = Counted(run.workers, lambda done, total: run.callbacks.progress(title, done / total))
    return train_blendscape(
        data,
        run.template,
        poses_of(trained, run.template, data, workers),
        trained.estimate.rig.weights,
        num_betas=run.options.num_betas,
        workers=workers,
    )
