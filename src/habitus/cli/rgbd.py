"""`habitus rgbd`: a body from depth and colour images."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import FAILED_FIT, Strict, plain, say, screen
from habitus.jobs.options import RgbdOptions, metavar

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.fit.points.depth_result import RgbdFit


@dataclass(frozen=True, kw_only=True)
class _Files:
    folder: Annotated[Path, tyro.conf.Positional, metavar("FOLDER")]
    """The views: our layout, Open3D's or TUM's; or one organised point cloud (.pcd)."""
    out: Annotated[Path, metavar("FOLDER")]
    """Output folder: body.npz, body.glb, measurements.csv, metrics.json and report.html; with
    --people all a folder of these for each person.
    """
    body: Annotated[str, metavar("NAME|FILE")] = "default"
    """Body to fit: female, male, neutral, a file, or default: women's or men's, whichever has the
    lower error.
    """


@dataclass(frozen=True, kw_only=True)
class Rgbd(Strict, RgbdOptions, _Files):
    """Fit a body to the images of a depth camera: one view or several, with colour or without.

    habitus rgbd views --out results

    habitus rgbd views --out results --turns 0 45 --body female

    habitus rgbd frame.pcd --people all --out results

    The folder holds depth images of 16 bits, the cameras' intrinsics and, where available, colour
    images and an image of the empty room. `docs/rgbd.md` explains how to capture, and which folders
    and names are understood.
    """


OPTIONS = Rgbd
ABOUT = Rgbd.__doc__
NEEDS = ("habitus.jobs.rgbd",)


def run(options: Rgbd, console: "Console | None" = None) -> int:
    """Do what the options say; 3 under ``strict`` where the fit failed by its verdict. Raises
    HabitusError for bad input.
    """
    from habitus.jobs.rgbd import rgbd, rgbd_people

    console = console or screen(options.quiet)
    given = (options.folder, options.out, options.body)
    kept = {"options": options, "progress": lambda text: say(console, text, "note")}
    fits = [rgbd(*given, **kept)] if options.people == "one" else rgbd_people(*given, **kept)
    for fit in fits:
        _print_fit(fit, console)
    say(console, f"wrote {plain(options.out)}: open report.html")
    failed = any(fit.verdict.level == "failed" for fit in fits)
    return FAILED_FIT if options.strict and failed else 0


def _print_fit(fit: "RgbdFit", console: "Console") -> None:
    for text in fit.warnings:
        say(console, text, "note")
    say(console, str(fit.verdict))
    girths = ("height_m", "chest_circumference_m", "waist_circumference_m", "hip_circumference_m")
    measured = [
        f"{name.split('_')[0]} {100 * fit.measurements[name]:.1f} cm"
        for name in girths
        if name in fit.measurements
    ]
    if measured:
        say(console, ", ".join(measured))


def left(options: Rgbd) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
