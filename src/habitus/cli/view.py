"""`habitus view`: bodies, results and scans in the browser."""

import webbrowser
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import say, screen
from habitus.jobs.options import Flag, metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class View:
    """Show bodies, results, motions and scans in the browser, side by side, until Ctrl-C.

    A body has sliders for its shape and any joint, its landmarks and measurements; results and
    motions play. For instance: habitus view default; habitus view results/walk/body.npz scan.ply
    """

    sources: Annotated[tuple[str, ...], tyro.conf.Positional, metavar("default|FILE")]
    """A bundled model or a model's file, a fit's body.npz, a motion (npz), a mesh or a point cloud.
    """
    body: Annotated[str | None, unset("default|FILE")] = None
    """The body of motions that do not name theirs."""
    up: Annotated[str, metavar("+y|+z|…")] = "+y"
    """Up axis of meshes and point clouds."""
    port: Annotated[int, metavar("N")] = 8080
    """Port of the page on this machine; the next free one where it is taken."""
    open: Flag = False
    """Open the page in the default browser."""
    quiet: Flag = False
    """Print nothing but errors; the page's address is not known then, unless --open opens it."""


OPTIONS = View
ABOUT = View.__doc__
NEEDS = ("habitus.jobs.viewing",)


def run(options: View, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.viewing import view

    console = console or screen(options.quiet)
    shown = view(options.sources, body=options.body, up=options.up, port=options.port)
    try:
        say(console, f"{shown.address} shows {', '.join(options.sources)}; Ctrl-C ends it")
        if options.open:
            webbrowser.open(shown.address)
        shown.wait()
    except KeyboardInterrupt:
        pass  # the usual end
    finally:
        shown.close()


def left(options: View) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
