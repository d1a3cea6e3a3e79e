"""`habitus select-poses`: the poses that determine a person's shape best."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from habitus.cli.screen import Quiet, plain, say, screen
from habitus.jobs.options import PoseSelectionOptions, metavar

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, kw_only=True)
class _Files:
    out: Annotated[Path, metavar("FILE.npz")]
    """Receives the poses, the best first, as a motion of one pose a second."""


@dataclass(frozen=True, kw_only=True)
class SelectPoses(Quiet, PoseSelectionOptions, _Files):
    """Choose the poses of a marker "body scan": together they determine the shape best with a
    layout's markers.

    habitus select-poses --layout mosh-47 --count 12 --out poses.npz

    See `docs/selecting-markers.md`; `habitus retarget poses.npz --target default --out poses` gives
    them as meshes.
    """


OPTIONS = SelectPoses
ABOUT = SelectPoses.__doc__
NEEDS = ("habitus.jobs.selection",)


def run(options: SelectPoses, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.selection import select_poses

    console = console or screen(options.quiet)
    choice, _ = select_poses(options=options, out=options.out)
    for k, (error, random) in enumerate(zip(choice.errors, choice.random, strict=True), 1):
        say(
            console,
            f"{k:3d} poses: shape error {1e3 * error:.1f} mm; as many at random: "
            f"{1e3 * random:.1f} mm",
        )
    say(console, f"{len(choice.poses)} of {options.candidates} poses, {plain(options.out)}")


def left(options: SelectPoses) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
