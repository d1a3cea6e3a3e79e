"""`habitus live`: one person followed through a live stream of markers."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.first_run import told_of_compilation
from habitus.cli.screen import Flag, say, screen, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Live:
    """Follow one person through a live stream of markers: shape from the first seconds, then pose
    frame by frame.

    A line a second says how it goes; what is lost, leaves, returns or is relabelled is said. Ctrl-C
    ends it, and OUT
    then holds all that was followed. For instance: habitus live --source natnet 192.168.1.5 --view
    --send vmc
    --out take.npz
    """

    source: Literal["replay", "natnet", "qtm"]
    """Where frames come from: a capture file played as a stream, OptiTrack's Motive, Qualisys Track
    Manager.
    """
    address: Annotated[str | None, tyro.conf.Positional, unset("FILE|HOST[:PORT]")] = None
    """The file to play, or the computer that streams; this one without."""
    out: Annotated[Path | None, unset("FILE.npz|FILE.glb|DIR")] = None
    """Where the result goes at the end; nothing is kept without."""
    known: Annotated[Path | None, unset("body.npz")] = None
    """A person who was fitted before with the same markers: the shape is not sought again."""
    layout: Annotated[str, tyro.conf.arg(metavar="auto|NAME|FILE")] = "auto"
    """Which marker sits where; "auto" picks a layout by the stream's labels."""
    body: Annotated[str, tyro.conf.arg(metavar="default|FILE")] = "default"
    """The body model."""
    subject: Annotated[str | None, unset("NAME")] = None
    """Whose markers, where a stream holds several people's."""
    sex: Literal["neutral", "female", "male"] = "neutral"
    """Which model of the body."""
    fps: Annotated[float | None, unset("HZ")] = None
    """How fast a file is played, 0 for as fast as it can be followed; or the rate of a stream that
    tells it wrong.
    """
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = 5.0
    """How long frames are gathered to find the shape; move meanwhile."""
    stop_after: Annotated[float | None, unset("S")] = None
    """End by itself after so many seconds."""
    view: Flag = False
    """Show body, markers and quality in the browser."""
    port: Annotated[int, tyro.conf.arg(metavar="N")] = 8080
    """Of the page that --view serves."""
    send: Annotated[tuple[str, ...], unset("osc|vmc[=HOST[:PORT]] …")] = ()
    """Send joint rotations on: osc (this project's messages, to port 9000), vmc (avatars, to port
    39539).
    """
    quiet: Flag = False
    """Print nothing but errors."""


OPTIONS = Live
ABOUT = Live.__doc__
NEEDS = ("habitus.jobs.live", "numba.core.event")


def run(options: Live, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.live import live
    from habitus.jobs.live_sinks import sinks

    console = console or screen(options.quiet)
    made = sinks(
        options.send, options.port if options.view else None, lambda text: say(console, text)
    )
    with told_of_compilation(options.quiet):
        fit = live(
            options.source,
            options.address,
            options.out,
            known=options.known,
            layout=options.layout,
            body=options.body,
            subject=options.subject,
            sex=options.sex,
            fps=options.fps,
            seconds=options.seconds,
            stop_after=options.stop_after,
            keep=False,
            sinks=made,
            say=lambda text, mark: say(console, text, mark),
            on_status=lambda line: say(console, line),
        )
    if fit is not None:
        say(console, f"{fit.num_frames} frames: {fit.verdict}")
    if options.out is not None:
        say(console, f"wrote {options.out}")


def left(options: Live) -> str:
    """What a run that was stopped has left."""
    return "nobody was followed yet; nothing was written"
