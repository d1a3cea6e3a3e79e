"""`habitus train-dynamics`: from people in motion to a body whose soft tissue moves."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import Quiet, compilation_notice, plain, progress_bar, say, screen
from habitus.jobs.options import metavar, unset
from habitus.jobs.train_dynamics import DynamicsTrainingOptions

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from habitus.jobs.train_dynamics import DynamicsTraining


@dataclass(frozen=True, kw_only=True)
class _Files:
    datasets: Annotated[tuple[Path, ...], tyro.conf.Positional, metavar("DATASET [DATASET …]")]
    """Sequences in any format of "habitus train" (npz, zarr, Dyna's h5, …), with betas, pose, trans
    and rate_hz where known.
    """
    out: Annotated[Path, metavar("FOLDER")]
    """Folder for the results."""


@dataclass(frozen=True, kw_only=True)
class TrainDynamics(Quiet, DynamicsTrainingOptions, _Files):
    """Learn how soft tissue moves: dynamic blend shapes of a body, and what predicts them from its
    motion (DMPL).

    Datasets are sequences of registrations of people in motion, all in the body's topology. OUT
    receives model.npz (the body with dynamics) and dynamics.json (what was learned, and the errors
    on --test).
    """

    workers: Annotated[int | None, unset("N")] = None
    """Threads to work with; by default one per core."""


OPTIONS = TrainDynamics
ABOUT = TrainDynamics.__doc__
NEEDS = ("habitus.jobs.train_dynamics", "rich.progress", "numba.core.event")


def run(options: TrainDynamics, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.train_dynamics import train_dynamics

    console = console or screen(options.quiet)
    with compilation_notice(options.quiet), progress_bar(console) as bar:
        task = bar.add_task("open", total=1.0)
        training = train_dynamics(
            options.datasets,
            options.out,
            options=options,
            workers=options.workers,
            progress=lambda stage, share: bar.update(task, description=stage, completed=share),
        )
    console.print(learned(training))
    if training.errors:
        console.print(errors(training))
    say(console, f"results are in {options.out}")


def left(options: TrainDynamics) -> str:
    """What a stopped run leaves."""
    return f"nothing was written to {options.out}"


def learned(training: "DynamicsTraining") -> "Table":
    """One row a component, and how the mean person's flesh swings."""
    from rich.table import Table

    numbers = training.numbers()
    chosen = numbers["chosen"]
    table = Table(
        title=f"dynamics from {numbers['frames']:,} frames at {numbers['rate_hz']:g} Hz; running "
        "free on motions held "
        f"out leaves {100 * chosen['error']:.0f} % of the variance ({chosen['shape_features']} "
        "shape coefficients)"
    )
    for heading in (
        "component",
        "variance, %",
        "moves up to, mm",
        "swings at, Hz",
        "damping ratio",
    ):
        table.add_column(heading, justify="right")
    modes = numbers["modes"]
    for k, (share, size) in enumerate(
        zip(numbers["variance_shares"], numbers["size_mm"], strict=True)
    ):
        hz, ratio = ("", "") if k >= len(modes) else (f"{one:.2f}" for one in modes[k].values())
        table.add_row(str(k + 1), f"{100 * share:.1f}", f"{size:.1f}", hz, ratio)
    return table


def errors(training: "DynamicsTraining") -> "Table":
    """One row a sequence that was kept out."""
    from rich.table import Table

    table = Table(
        title="errors on sequences kept out (root mean squares): without dynamics, simulated, at "
        "best"
    )
    for heading in ("sequence", "place, mm", "velocity, mm/s", "acceleration, m/s²"):
        table.add_column(heading, justify="left" if heading == "sequence" else "right")
    for one in training.errors:
        cells = [" · ".join(f"{value:.1f}" for value in column) for column in one.errors.T]
        table.add_row(plain(one.name), *cells)
    return table
