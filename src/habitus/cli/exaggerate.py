"""`habitus exaggerate`: soft tissue made stronger or weaker."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.jobs.options import metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Exaggerate:
    """Scale the soft-tissue motion of a fit.

    habitus exaggerate results/walk/body.npz --factor 2 --out walk_x2.glb

    Poses and translations are unchanged. See `docs/exaggerating-and-retargeting.md`.
    """

    source: Annotated[Path, tyro.conf.Positional, metavar("BODY.npz")]
    """A fit's body.npz, or a motion that habitus wrote."""
    out: Annotated[Path, metavar("FILE.npz|glb|FOLDER")]
    """File for the motion; a folder receives an OBJ for each frame."""
    factor: Annotated[float, metavar("FACTOR")] = 2.0
    """Scale of the deviation from the mean: 1.5 or 2 look natural, 4 seldom; 0 removes all motion.
    """
    body: Annotated[str | None, unset("FILE")] = None
    """The body model, where the file names no bundled one."""


OPTIONS = Exaggerate
ABOUT = Exaggerate.__doc__
NEEDS = ("habitus.jobs.motions",)


def run(options: Exaggerate, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.body.soft_tissue import USUAL, skin_motion
    from habitus.jobs.motions import exaggerate

    console = console or screen()
    exaggerated = exaggerate(options.source, options.factor, body=options.body, out=options.out)
    if options.factor > USUAL:
        say(console, f"above {USUAL:g} bodies often look unnatural", "note")
    moved = 1e3 * skin_motion(exaggerated)
    say(
        console,
        f"{exaggerated.num_frames} frames; soft tissue moves the skin by {moved:.1f} mm (RMS), "
        f"{plain(options.out)}",
    )


def left(options: Exaggerate) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
