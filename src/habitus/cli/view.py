"""`habitus view`: bodies, results and scans in the browser."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import Flag, say, screen, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class View:
    """Show bodies, results, motions and scans in the browser, side by side, until Ctrl-C.

    A body comes with sliders for its shape and any joint, its landmarks and measurements; a result
    and a motion play. For instance: habitus view default; habitus view results/walk/body.npz
    scan.ply
    """

    sources: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="default|FILE")]
    """A model that comes along or its file, a fit's body.npz, a motion (npz), a mesh or a cloud of
    points.
    """
    body: Annotated[str | None, unset("default|FILE")] = None
    """The body of motions that do not name theirs."""
    up: Annotated[str, tyro.conf.arg(metavar="+y|+z|…")] = "+y"
    """The axis of meshes and clouds of points that points up."""
    port: Annotated[int, tyro.conf.arg(metavar="N")] = 8080
    """Where the page is served on this machine; the next free one where it is taken."""
    quiet: Flag = False
    """Print nothing but errors."""


OPTIONS = View
ABOUT = View.__doc__
NEEDS = ("habitus.jobs.viewing",)


def run(options: View, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.viewing import view

    console = console or screen(options.quiet)
    shown = view(options.sources, body=options.body, up=options.up, port=options.port)
    say(console, f"{shown.address} shows {', '.join(options.sources)}; Ctrl-C ends it")
    try:
        shown.wait()
    finally:
        shown.close()


def left(options: View) -> str:
    """What a run that was stopped has left."""
    return "nothing was written"
