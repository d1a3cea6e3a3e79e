"""`habitus mosh`: from capture files to moving bodies."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import (
    Strict,
    closing,
    compilation_notice,
    exit_code,
    print_outcome,
    print_table,
    progress_bar,
    say,
    screen,
)
from habitus.errors import shown
from habitus.jobs.options import BodyOption, MoshOptions, metavar, unset

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.jobs.batch import Outcome
    from habitus.types import Progress


@dataclass(frozen=True, kw_only=True)
class _Files(BodyOption):
    captures: Annotated[
        tuple[Path, ...], tyro.conf.Positional, unset("CAPTURE|FOLDER [CAPTURE|FOLDER …]")
    ]
    """C3D, TRC, Motive CSV, QTM TSV or npz files of one subject; or folders."""
    out: Annotated[Path, metavar("FOLDER")]
    """Folder for the results."""


@dataclass(frozen=True, kw_only=True)
class Mosh(Strict, MoshOptions, _Files):
    """Fit a body to motion captures: shape, pose in every frame, soft tissue, and the placement of
    each marker.

    Several files are one subject. Of a folder every capture below it is fitted; those in one folder
    that name the same subject and have the same marker placements are one subject. For each,
    OUT/<capture's name>/ receives body.npz (AMASS keys), body.glb (animated mesh), metrics.json and
    report.html (opens offline in a browser). A capture that fails is skipped and listed at the end;
    the exit code is then 1.
    """


OPTIONS = Mosh
ABOUT = Mosh.__doc__
NEEDS = ("habitus.jobs.batch", "rich.table", "rich.progress", "numba.core.event")


def run(options: Mosh, console: "Console | None" = None) -> int:
    """Do what the options say; 1 where one of several captures failed, 3 under ``strict`` where a
    fit failed by its verdict. Raises HabitusError for bad input.
    """
    console = console or screen(options.quiet)
    several = len(options.captures) > 1 or any(path.is_dir() for path in options.captures)
    at_once = several and not console.is_terminal  # a table and a bar want the end
    with compilation_notice(options.quiet), progress_bar(console) as bar:
        task = bar.add_task("read", total=1.0)
        outcomes = _fit(
            options,
            lambda stage, share: bar.update(task, description=shown(stage), completed=share),
            partial(print_outcome, console=console) if at_once else (lambda outcome: None),
        )
    if not several and all(outcome.error for outcome in outcomes):
        raise next(outcome.error for outcome in outcomes if outcome.error)
    for outcome in () if at_once else outcomes:
        print_outcome(outcome, console)
    if console.is_terminal:
        print_table(outcomes, console)
    if several:
        say(console, closing(outcomes, options.out))
    return exit_code(outcomes, options.strict)


def _fit(
    options: Mosh, progress: "Progress", on_done: "Callable[[Outcome], None]"
) -> "list[Outcome]":
    from habitus.jobs.batch import fit_all
    from habitus.jobs.mosh import recipe_of

    return fit_all(
        recipe_of(options),
        options.captures,
        options.out,
        options.body,
        progress=progress,
        on_done=on_done,
    )


def left(options: Mosh) -> str:
    """What a stopped run leaves."""
    return "finished captures are complete"
