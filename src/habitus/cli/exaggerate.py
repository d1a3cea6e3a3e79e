"""`habitus exaggerate`: soft tissue made stronger or weaker."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import plain, say, screen, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Exaggerate:
    """Make the soft tissue of a fit move more, or less, than it did.

    habitus exaggerate results/walk/body.npz --factor 2 --out walk_x2.glb

    Poses and places stay as they are. `docs/exaggerating-and-retargeting.md` shows it.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BODY.npz")]
    """A fit's body.npz, or a motion that habitus wrote."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.npz|glb|FOLDER")]
    """Where the motion is written; a folder receives an OBJ a frame."""
    factor: Annotated[float, tyro.conf.arg(metavar="TIMES")] = 2.0
    """How many times as far from its mean: 1.5 or 2 look natural, 4 seldom; 0 takes all of its
    motion away.
    """
    body: Annotated[str | None, unset("FILE")] = None
    """The body model, where the file names none that comes along."""


OPTIONS = Exaggerate
ABOUT = Exaggerate.__doc__
NEEDS = ("habitus.jobs.motions",)


def run(options: Exaggerate, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.body.soft_tissue import USUAL, skin_motion
    from habitus.jobs.motions import exaggerate

    console = console or screen()
    found = exaggerate(options.source, options.factor, body=options.body, out=options.out)
    if options.factor > USUAL:
        say(console, f"above {USUAL:g} bodies often look unnatural", "note")
    moved = 1e3 * skin_motion(found)
    say(
        console,
        f"{found.num_frames} frames; soft tissue moves the skin by {moved:.1f} mm (RMS), "
        f"{plain(options.out)}",
    )


def left(options: Exaggerate) -> str:
    """What a run that was stopped has left."""
    return "nothing was written"
