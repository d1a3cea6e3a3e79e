"""`habitus rgbd`: a body from depth and colour images."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import plain, say, screen, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Rgbd:
    """Find a person's body in the images of a depth camera: one view or several, with colour or
    without.

    habitus rgbd views --out results

    habitus rgbd views --out results --turns 0 45 --body female

    The folder holds depth images of 16 bits, the cameras' intrinsics and, as far as there are,
    colour images and a shot of the empty room. `docs/rgbd.md` says how to capture, and which
    folders and names are understood.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """The views: our layout, Open3D's or TUM's."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Where body.npz, body.glb, measurements.csv, metrics.json and report.html go."""
    body: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "default"
    """The body to fit: female, male, neutral, a model's file, or default: women's or men's, as the
    views say.
    """
    turns: Annotated[tuple[float, ...], tyro.conf.arg(metavar="DEGREES …")] = ()
    """How far the person was turned in each view, to their left; found by trying where not given.
    """
    views: Annotated[tuple[int, ...], tyro.conf.arg(metavar="NUMBERS")] = ()
    """Which views to use, counted from 0; all, up to 12, where not given."""
    depth_unit: Annotated[float | None, unset("METRES")] = None
    """What one step of depth is, where no file tells it: 0.001, or 0.0002 for TUM's."""
    cameras: Annotated[Path | None, unset("FILE")] = None
    """Intrinsics (json, yaml) that lie elsewhere."""
    age: Annotated[float | None, unset("YEARS")] = None
    """The person's age, for a child's body."""
    clothes: Annotated[float | None, unset("MM")] = None
    """How thick tight clothes are on trunk and thighs, which is taken off the skin: 1 where not
    given, 0 without.
    """
    hair: Annotated[float | None, unset("MM")] = None
    """How thick hair and cap are, which is taken off the head: 3 where not given."""


OPTIONS = Rgbd
ABOUT = Rgbd.__doc__
NEEDS = ("habitus.jobs.rgbd",)


def run(options: Rgbd, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.rgbd import rgbd

    console = console or screen()
    fit = rgbd(
        options.folder,
        options.out,
        body=options.body,
        turns=options.turns or None,
        views=options.views or None,
        depth_unit=options.depth_unit,
        cameras=options.cameras,
        age=options.age,
        clothes_mm=options.clothes,
        hair_mm=options.hair,
        progress=lambda text: say(console, text, "note"),
    )
    for text in fit.warnings:
        say(console, text, "note")
    say(console, str(fit.verdict))
    girths = ("height_m", "chest_circumference_m", "waist_circumference_m", "hip_circumference_m")
    told = [
        f"{name.split('_')[0]} {100 * fit.measurements[name]:.1f} cm"
        for name in girths
        if name in fit.measurements
    ]
    if told:
        say(console, ", ".join(told))
    say(console, f"wrote {plain(options.out)}: open report.html")


def left(options: Rgbd) -> str:
    """What a run that was stopped has left."""
    return "nothing was written"
