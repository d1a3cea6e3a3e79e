"""`habitus gait`: joint angles by convention, strides, joint moments."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import Quiet, plain, say, screen
from habitus.jobs.options import GaitOptions, metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, kw_only=True)
class _Files:
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, metavar("CAPTURE|RESULT")]
    """Captures of one person, which are fitted first, or result folders."""
    out: Annotated[Path, metavar("FOLDER")]
    """Output folder: angles.csv, cycles.csv, dynamics.csv, gait.json and gait.html; of several
    captures a folder of these each.
    """
    captures: Annotated[Path | None, unset("FOLDER")] = None
    """Folder with the .c3d files of result folders, for force plates and events."""


@dataclass(frozen=True, kw_only=True)
class Gait(Quiet, GaitOptions, _Files):
    """Compute joint angles by convention, strides, and joint moments from force plates.

    habitus gait static.c3d walk1.c3d walk2.c3d --out gait

    habitus gait results/walk1 --captures trials --convention pig --out gait

    `docs/for-laboratories.md` says what each number means and what is not validated.
    """


OPTIONS = Gait
ABOUT = Gait.__doc__
NEEDS = ("habitus.jobs.gait",)


def run(options: Gait, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.gait import gaits
    from habitus.results.gait import fit_verdict

    console = console or screen(options.quiet)
    results = gaits(
        options.sources,
        options.out,
        captures=options.captures,
        options=options,
        progress=lambda text: say(console, text, "note"),
    )
    for result in results:
        for contact in result.contacts:
            if contact.refused:
                say(console, f"{result.name}: plate {contact.plate}: {contact.refused}", "note")
        verdict = fit_verdict(result)
        if verdict is not None and verdict["level"] != "good":
            say(console, f"{result.name}: the fit is {verdict['level']}: see gait.html", "note")
        share = result.residual_share
        forces = "" if share is None else f", residual {100 * share:.1f} % of body weight"
        say(console, f"{result.name}: {len(result.strides)} strides{forces}")
    say(console, f"wrote {plain(options.out)}: open gait.html")


def left(options: Gait) -> str:
    """What a stopped run leaves."""
    return "finished captures are complete"
