"""`habitus label`: names for the points of a capture."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import Quiet, compilation_notice, say, screen
from habitus.jobs.options import LabelOptions, metavar

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, kw_only=True)
class _Files:
    capture: Annotated[Path, tyro.conf.Positional, metavar("CAPTURE")]
    """C3D, TRC, Motive CSV, QTM TSV or npz file."""
    out: Annotated[Path, metavar("FILE.c3d|trc")]
    """File of the labelled capture."""


@dataclass(frozen=True, kw_only=True)
class Label(Quiet, LabelOptions, _Files):
    """Label the points of an unlabelled capture: *1, *2, …, broken trajectories, or wrong names.

    The file's own labels are ignored. OUT is the file with the estimated labels, everything else
    unchanged, points without a likely label as *1, *2, …; beside it OUT's name with .labels.json
    gives the confidence of each label. For instance:
    habitus label raw.c3d --like static_labelled.c3d --out labelled.c3d
    """


OPTIONS = Label
ABOUT = Label.__doc__
NEEDS = ("habitus.jobs.label", "numba.core.event")


def run(options: Label, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.label import label

    console = console or screen(options.quiet)
    with compilation_notice(options.quiet):
        labelled = label(options.capture, options.out, options=options)
    for warning in labelled.source.warnings:
        say(console, warning, "warning:")
    by = (
        f"like {labelled.report['like']}"
        if "like" in labelled.report
        else f"layout {labelled.report['layout']}"
    )
    say(console, f"{labelled.source.name}, {by}: {labelled.summary}")
    say(console, f"wrote {options.out}")


def left(options: Label) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
