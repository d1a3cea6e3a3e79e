"""`habitus retarget`: another body in the same motion."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.jobs.options import metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Retarget:
    """Transfer the motion of a fit to another body, with its soft tissue and foot contacts.

    habitus retarget results/walk/body.npz --target character.obj --out character_walk.glb

    habitus retarget results/walk/body.npz --target female --out her_walk.npz

    See `docs/exaggerating-and-retargeting.md`.
    """

    source: Annotated[Path, tyro.conf.Positional, metavar("BODY.npz")]
    """A fit's body.npz, a motion that habitus wrote, or an npz in AMASS's style."""
    target: Annotated[str, metavar("FILE|BETAS|NAME")]
    """A person (npz), a mesh of the body's topology (obj, ply), betas (1.5,-0.5), or neutral,
    female, male.
    """
    out: Annotated[Path, metavar("FILE.npz|glb|FOLDER")]
    """File for the motion; a folder receives an OBJ for each frame."""
    body: Annotated[str | None, unset("FILE")] = None
    """The body model of the source, where it names no bundled one."""


OPTIONS = Retarget
ABOUT = Retarget.__doc__
NEEDS = ("habitus.jobs.motions",)


def run(options: Retarget, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.motions import retarget

    console = console or screen()
    retargeted = retarget(options.source, options.target, body=options.body, out=options.out)
    slip, below = ([1e3 * value for value in each] for each in (retargeted.slip, retargeted.below))
    say(console, f"legs are {retargeted.scale:.2f} times as long, and so is the way", "note")
    if retargeted.standing:
        say(
            console,
            f"feet stand for {retargeted.standing:.1f} s and move there by {slip[2]:.0f} mm/s "
            f"(source {slip[0]:.0f}, without keeping them {slip[1]:.0f})",
            "note",
        )
    say(console, f"lowest point {below[2]:.0f} mm from the ground (source {below[0]:.0f})", "note")
    say(
        console,
        f"{retargeted.motion.num_frames} frames of {plain(retargeted.motion.body_name)}, "
        f"{plain(options.out)}",
    )


def left(options: Retarget) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
