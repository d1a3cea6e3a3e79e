"""`habitus select-poses`: which poses tell a person's shape best."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import plain, say, screen

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class SelectPoses:
    """Choose the poses of a marker "body scan": together they tell the shape best with a layout's
    markers.

    habitus select-poses --layout mosh-47 --count 12 --out poses.npz

    `docs/selecting-markers.md` tells how; `habitus retarget poses.npz --target default --out poses`
    gives them as meshes.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE.npz")]
    """Receives the poses, the best first, as a motion of one pose a second."""
    layout: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "mosh-47"
    """Which markers the person wears."""
    count: Annotated[int, tyro.conf.arg(metavar="N")] = 12
    """How many poses."""
    candidates: Annotated[int, tyro.conf.arg(metavar="N")] = 200
    """Poses to choose among: plain ones, and others drawn from the pose prior."""
    body: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "default"
    """The body model."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the candidates."""


OPTIONS = SelectPoses
ABOUT = SelectPoses.__doc__
NEEDS = ("habitus.jobs.selection",)


def run(options: SelectPoses, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.selection import select_poses

    console = console or screen()
    choice, _ = select_poses(
        options.layout,
        options.count,
        candidates=options.candidates,
        body=options.body,
        seed=options.seed,
        out=options.out,
    )
    for k, (error, random) in enumerate(zip(choice.errors, choice.random, strict=True), 1):
        say(
            console,
            f"{k:3d} poses: shape known to {1e3 * error:.1f} mm; so many at random: "
            f"{1e3 * random:.1f} mm",
        )
    say(console, f"{len(choice.poses)} of {options.candidates} poses, {plain(options.out)}")


def left(options: SelectPoses) -> str:
    """What a run that was stopped has left."""
    return "nothing was written"
