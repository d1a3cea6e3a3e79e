"""`habitus label`: names for the points of a capture."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.first_run import told_of_compilation
from habitus.cli.screen import Flag, say, screen, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Label:
    """Name the points of a capture that nobody labelled: *1, *2, …, broken trajectories, or wrong
    names.

    What the file calls its points is not read. OUT is the file with the found labels, everything
    else as it was, points without a likely label as *1, *2, …; beside it OUT's name with
    .labels.json says how sure each label is. For instance: habitus label raw.c3d --like
    static_labelled.c3d --out labelled.c3d
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """C3D, TRC, Motive CSV, QTM TSV or npz file."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.c3d|trc")]
    """Where the labelled capture is written."""
    layout: Annotated[str, tyro.conf.arg(metavar="auto|NAME|FILE")] = "auto"
    """Which markers there are; "auto" takes the shipped layout that fits best. With --like: of its
    labels.
    """
    like: Annotated[Path | None, unset("LABELLED.c3d")] = None
    """A labelled capture of the same person with the same markers: tells shape and places, and is
    the surest way.
    """
    min_confidence: Annotated[float, tyro.conf.arg(metavar="0..1")] = 0.45
    """Labels less likely than this are left out."""
    people: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """How many people are in the capture, all in the same markers; their labels begin with
    person1:, person2:, …
    """
    body: Annotated[str, tyro.conf.arg(metavar="default|FILE")] = "default"
    """The body model that labels are judged by."""
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second, where the file does not say or says it wrong."""
    quiet: Flag = False
    """Print nothing but errors."""


OPTIONS = Label
ABOUT = Label.__doc__
NEEDS = ("habitus.jobs.label", "numba.core.event")


def run(options: Label, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.label import label

    console = console or screen(options.quiet)
    with told_of_compilation(options.quiet):
        found = label(
            options.capture,
            options.out,
            layout=options.layout,
            like=options.like,
            min_confidence=options.min_confidence,
            people=options.people,
            body=options.body,
            fps=options.fps,
        )
    for warning in found.source.warnings:
        say(console, warning, "warning:")
    by = (
        f"like {found.report['like']}"
        if "like" in found.report
        else f"layout {found.report['layout']}"
    )
    say(console, f"{found.source.name}, {by}: {found.summary}")
    say(console, f"wrote {options.out}")


def left(options: Label) -> str:
    """What a run that was stopped has left."""
    return "nothing was written"
