"""`habitus live`: one person followed through a live stream of markers or of keypoints."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import Quiet, compilation_notice, say, screen
from habitus.jobs.options import Flag, LiveOptions, metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, kw_only=True)
class _Files:
    source: Literal["replay", "natnet", "qtm", "detections"]
    """Source of frames: a capture file played as a stream, OptiTrack's Motive, Qualisys Track
    Manager, or detectors of 2D keypoints that send JSON over UDP (with --cameras).
    """
    address: Annotated[str | None, tyro.conf.Positional, unset("FILE|HOST[:PORT]")] = None
    """The file to play, or the computer that streams; by default this one. Of detections the
    address that is listened on, by default 127.0.0.1:5005.
    """
    out: Annotated[Path | None, unset("FILE.npz|FILE.glb|FOLDER")] = None
    """Where the result is written at the end; without it nothing is kept."""
    view: Flag = False
    """Show body, markers or keypoints, and quality in the browser."""
    port: Annotated[int, metavar("N")] = 8080
    """Port of the page that --view serves."""
    send: Annotated[tuple[str, ...], unset("osc|vmc[=HOST[:PORT]] …")] = ()
    """Send joint rotations: osc (this project's messages, port 9000), vmc (avatars, port 39539)."""


@dataclass(frozen=True, kw_only=True)
class Live(Quiet, LiveOptions, _Files):
    """Follow one person through a live stream of markers, or of 2D keypoints in calibrated cameras:
    shape from the first seconds, then pose frame by frame.

    A line a second reports the state; markers that are lost or relabelled and a person who leaves
    or returns are reported. Ctrl-C ends it, and OUT then holds all frames that were followed. For
    instance: habitus live --source natnet 192.168.1.5 --view --send vmc --out take.npz, or
    habitus live --source detections --cameras Calib.toml --view
    """


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
    with compilation_notice(options.quiet):
        fit = live(
            options.source,
            options.address,
            options.out,
            options=options,
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
    """What a stopped run leaves."""
    return "no person was followed yet; nothing was written"
