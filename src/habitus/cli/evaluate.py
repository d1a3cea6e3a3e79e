"""`habitus evaluate`: trained models against held-out registrations, as the papers' figures."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import Quiet, Workers, compilation_notice, plain, progress_bar, say, screen
from habitus.errors import HabitusError
from habitus.jobs.learn_options import EvaluationOptions
from habitus.jobs.options import Flag, metavar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from habitus.evaluate.generalisation import Generalisation
    from habitus.jobs.evaluate import Evaluation, KnownEvaluation

_WIDE = 200  # columns of a table that goes to a file or a pipe
_SPEED_OVER = (
    600.0  # seconds: models differ in speed, so that only a long look back tells the time left
)


@dataclass(frozen=True, kw_only=True)
class _Files:
    paths: Annotated[tuple[str, ...], tyro.conf.Positional, metavar("MODEL [MODEL …] DATASET")]
    """Body models (npz, pkl, or "default"); last the registrations, as for
    `habitus train`.
    """
    out: Annotated[Path, metavar("FOLDER")]
    """Folder for the results."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(Quiet, Workers, EvaluationOptions, _Files):
    """Measure body models on registrations of unseen people: errors, run time, variance, neck.

    OUT receives report.html (opens offline in a browser), evaluation.json (every number),
    per_vertex.npz (mean errors of vertices), and the folder figures (SVG and PNG).
    """

    known: Flag = False
    """Fit nothing: errors in the known poses and shapes of the dataset, beside plain LBS and DQBS
    (known.json).
    """


OPTIONS = Evaluate
ABOUT = Evaluate.__doc__
NEEDS = ("habitus.jobs.evaluate", "rich.progress", "numba.core.event")


def run(options: Evaluate, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""

    from habitus.jobs.evaluate import evaluate

    console = console or screen(options.quiet)
    *models, dataset = options.paths or ("",)
    if not models:
        raise HabitusError(
            "expected one or more models, then a dataset; see habitus evaluate --help"
        )
    if options.known:
        _run_known(options, console, models, dataset)
        return
    with compilation_notice(options.quiet), progress_bar(console, _SPEED_OVER) as bar:
        task = bar.add_task("read", total=1.0)
        evaluation = evaluate(
            models,
            dataset,
            options.out,
            options=options,
            workers=options.shared_by,
            progress=lambda stage, share: bar.update(task, description=stage, completed=share),
        )
    console.print(summary(evaluation))
    say(console, f"results are in {options.out}")


def _run_known(options: Evaluate, console: "Console", models: list[str], dataset: str) -> None:
    from habitus.jobs.evaluate import evaluate_known

    with compilation_notice(options.quiet), progress_bar(console, _SPEED_OVER) as bar:
        task = bar.add_task("read", total=1.0)
        evaluation = evaluate_known(
            models,
            dataset,
            options.out,
            options=options,
            workers=options.shared_by,
            progress=lambda stage, share: bar.update(task, description=stage, completed=share),
        )
    console.print(known_table(evaluation))
    say(console, f"results are in {options.out}")


def known_table(evaluation: "KnownEvaluation") -> "Table":
    """A row a model and group of people: errors, and how much of plain LBS's is gone."""
    from rich.table import Table

    table = Table(
        title="vertex error in known poses and shapes, mm, "
        f"{evaluation.registrations} registrations"
    )
    for heading in ("model", "people", "mean", "rms", "p95", "less than plain LBS"):
        table.add_column(heading, justify="left" if heading in ("model", "people") else "right")
    for name, groups in evaluation.models.items():
        for who, numbers in groups.items():
            cells = [f"{1e3 * numbers[key]:.2f}" for key in ("mean", "rms", "p95")]
            table.add_row(plain(name), who, *cells, f"{100 * numbers['removed']:.0f} %")
    return table


def left(options: Evaluate) -> str:
    """What a stopped run leaves."""
    return f"nothing was written to {options.out}"


def summary(evaluation: "Evaluation") -> "Table":
    """One row a model: mean errors with as many shape coefficients as all have."""
    from rich.table import Table

    lead = "" if evaluation.shown is None else f", {evaluation.shown} shape coefficients"
    table = Table(title=f"mean absolute vertex error, mm{lead}")
    kinds = ["noisy", "noise-free"] if evaluation.clean is not None else [""]
    for heading in (
        "model",
        *(f"{what} {kind}".strip() for what in ("model gen.", "pose gen.") for kind in kinds),
    ):
        table.add_column(heading, justify="left" if heading == "model" else "right")
    for entry in evaluation.models:
        cells = [text for curve in (entry.shape, entry.pose) for text in _errors(evaluation, curve)]
        table.add_row(plain(entry.name), *cells)
    return table


def _errors(evaluation: "Evaluation", curve: "Generalisation | None") -> list[str]:
    columns = 2 if evaluation.clean is not None else 1
    if curve is None:
        return ["–"] * columns
    k = -1 if evaluation.shown is None else curve.counts.index(evaluation.shown)
    means = [curve.means] if curve.clean_means is None else [curve.means, curve.clean_means]
    return [f"{1e3 * each[k]:.2f}" for each in means]
