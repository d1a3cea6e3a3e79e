"""`habitus train`: from registrations to a body model."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import Quiet, Workers, compilation_notice, plain, progress_bar, say, screen
from habitus.jobs.learn_options import TrainingOptions
from habitus.jobs.options import Flag, metavar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from habitus.jobs.train import Training
    from habitus.learn.callback import Record

_WIDE = 200  # columns of a table that goes to a file or a pipe
# Seconds. Steps of a round differ in length, so the remaining time is estimated from a long window.
_SPEED_OVER = 3600.0


@dataclass(frozen=True, kw_only=True)
class _Files:
    datasets: Annotated[tuple[Path, ...], tyro.conf.Positional, metavar("DATASET [DATASET …]")]
    """An npz, a zarr or mesh folder, a folder with registrations.csv, FAUST's meshes, Dyna's h5."""
    out: Annotated[Path, metavar("FOLDER")]
    """Folder for the results, and for the checkpoint."""


@dataclass(frozen=True, kw_only=True)
class Train(Quiet, Workers, TrainingOptions, _Files):
    """Learn a body model from registrations: meshes of people in poses, all in a template's
    topology.

    OUT receives model.npz and model.pkl (SMPL's names), poses.npz (poses, rest surfaces and joints
    of the people), and training.json (energies of every step, seconds, options). The same command
    resumes a stopped run.
    """

    restart: Flag = False
    """Discard the checkpoint in OUT and start again."""


OPTIONS = Train
ABOUT = Train.__doc__
NEEDS = ("habitus.jobs.train", "rich.progress", "numba.core.event")


def run(options: Train, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""

    from habitus.jobs.train import train

    console = console or screen(options.quiet)
    with compilation_notice(options.quiet), progress_bar(console, _SPEED_OVER) as bar:
        task = bar.add_task("open", total=1.0)

        def progress(stage: str, share: float) -> None:
            if bar.tasks[0].description != stage:
                bar.reset(task, description=stage)
            bar.update(task, completed=share)

        def on_warning(text: str) -> None:
            say(console, text, mark="note")

        def on_step(model: str, record: "Record") -> None:
            say(console, energy_line(model, record))

        trainings = train(
            options.datasets,
            options.out,
            options=options,
            restart=options.restart,
            workers=options.shared_by,
            progress=progress,
            on_step=on_step,
            on_warning=on_warning,
        )
    console.print(summary(trainings))
    say(console, f"results are in {options.out}")


def left(options: Train) -> str:
    """What a stopped run leaves."""
    if next(options.out.glob("**/progress.npz"), None) is None:
        return f"there is no checkpoint in {options.out} yet"
    return (
        f"the checkpoint in {options.out} is complete: the same command without --restart "
        "resumes from it"
    )


def energy_line(model: str, record: "Record") -> str:
    """A step's energy in one line."""
    terms = ", ".join(
        f"{name.replace('_', ' ')} {value:.4g}" for name, value in record.energy.terms.items()
    )
    return (
        f"{model}, round {record.round}, {record.step}: energy {record.energy.total:.6g} ({terms})"
    )


def summary(trainings: "list[Training]") -> "Table":
    """One row a model."""
    from rich.table import Table

    table = Table(title="trained models")
    for heading in (
        "model",
        "rounds",
        "energy before",
        "after",
        "data error, mm",
        "shapes",
        "minutes",
    ):
        table.add_column(
            heading, justify="left" if heading == "model" else "right", no_wrap=heading == "model"
        )
    for one in trainings:
        for name, trained in {"model": one.trained, **one.baselines}.items():
            first = trained.history[0].energy
            last = trained.history[-1].energy
            estimate = trained.estimate
            error = (last.terms["data"] / (len(estimate.pose) * trained.body.num_vertices)) ** 0.5
            table.add_row(
                plain(f"{one.sex} {name}".strip()),
                str(trained.history[-1].round),
                f"{first.total:.4g}",
                f"{last.total:.4g}",
                f"{1e3 * error:.2f}",
                str(trained.body.num_betas),
                f"{one.seconds[name] / 60:.1f}",
            )
    return table
