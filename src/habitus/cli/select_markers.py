"""`habitus select-markers`: which markers tell a body best."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import Flag, plain, progress_bar, say, screen

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class SelectMarkers:
    """Choose markers: from a set they go, or come, one by one, each the one that matters least, or
    most.

    habitus select-markers --from 114 --start 47 --out selection

    Sets are judged on posed people that the body has not seen. `docs/selecting-markers.md` tells
    how.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Receives selection.json, curve.svg, markers.svg, and layouts as TOML."""
    pool: Annotated[str, tyro.conf.arg(name="from", metavar="N|LAYOUT,…")] = "114"
    """The candidates: so many, spread over the body, or those of layouts."""
    start: Annotated[str, tyro.conf.arg(metavar="LAYOUT|47|67")] = "47"
    """The set to start from: markers of it are removed, and candidates are added to it."""
    goal: Literal["surface", "shape", "pose"] = "surface"
    """What shall be right: the posed surface, the person's shape at rest, or the joints' places."""
    region: Literal["all", "legs", "arms", "trunk", "head"] = "all"
    """Where it shall be right."""
    pairs: Flag = False
    """Left and right markers go and come together."""
    min_markers: Annotated[int, tyro.conf.arg(metavar="N")] = 5
    """How far markers are removed."""
    keep: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N …")] = (25, 67)
    """The sizes of sets that are written as layouts."""
    people: Annotated[int, tyro.conf.arg(metavar="N")] = 40
    """How many posed people sets are judged on."""
    body: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "default"
    """The body model."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the people."""


OPTIONS = SelectMarkers
ABOUT = SelectMarkers.__doc__
NEEDS = ("habitus.jobs.selection",)


def run(options: SelectMarkers, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.selection import select_markers

    console = console or screen()
    with progress_bar(console) as bar:
        tasks: dict[str, int] = {}

        def tell(stage: str, share: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=1.0)
            bar.update(tasks[stage], completed=share)  # type: ignore[arg-type]

        found = select_markers(
            options.pool,
            options.start,
            goal=options.goal,
            region=options.region,
            pairs=options.pairs,
            min_markers=options.min_markers,
            people=options.people,
            keep=options.keep,
            body=options.body,
            seed=options.seed,
            out=options.out,
            progress=tell,
        )
    for count, error in sorted(found.errors.items()):
        if count in (found.start, *options.keep) or count % 10 == 0 or count == min(found.errors):
            say(
                console,
                f"{count:4d} markers: {1e3 * error:6.1f} "
                f"mm{' (start)' if count == found.start else ''}",
            )
    say(
        console,
        f"{len(found.pool.candidates.labels)} candidates, error of the {found.goal}, "
        f"{plain(options.out)}",
    )


def left(options: SelectMarkers) -> str:
    """What a run that was stopped has left."""
    return "nothing was written"
