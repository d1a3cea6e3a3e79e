"""`habitus select-markers`: the markers that determine a body best."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from habitus.cli.screen import Quiet, plain, progress_bar, say, screen
from habitus.jobs.options import MarkerSelectionOptions, metavar

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, kw_only=True)
class _Files:
    out: Annotated[Path, metavar("FOLDER")]
    """Receives selection.json, curve.svg, markers.svg, and layouts as TOML."""


@dataclass(frozen=True, kw_only=True)
class SelectMarkers(Quiet, MarkerSelectionOptions, _Files):
    """Choose markers: from a set they are removed, or added, one by one, each time the one with the
    least, or the greatest, effect on the error.

    habitus select-markers --from 114 --start 47 --out selection

    Sets are evaluated on posed people that the body has not seen. See `docs/selecting-markers.md`.
    """


OPTIONS = SelectMarkers
ABOUT = SelectMarkers.__doc__
NEEDS = ("habitus.jobs.selection",)


def run(options: SelectMarkers, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.selection import select_markers

    console = console or screen(options.quiet)
    with progress_bar(console) as bar:
        tasks: dict[str, int] = {}

        def progress(stage: str, share: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=1.0)
            bar.update(tasks[stage], completed=share)  # type: ignore[arg-type]

        selection = select_markers(options=options, out=options.out, progress=progress)
    for count, error in sorted(selection.errors.items()):
        if (
            count in (selection.start, *options.keep)
            or count % 10 == 0
            or count == min(selection.errors)
        ):
            say(
                console,
                f"{count:4d} markers: {1e3 * error:6.1f} "
                f"mm{' (start)' if count == selection.start else ''}",
            )
    say(
        console,
        f"{len(selection.pool.candidates.labels)} candidates, error of the {selection.goal}, "
        f"{plain(options.out)}",
    )


def left(options: SelectMarkers) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
