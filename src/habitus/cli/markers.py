"""`habitus markers`: virtual markers of a body in motion, and captures with their gaps filled."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.errors import HabitusError
from habitus.jobs.options import metavar, unset

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.jobs.virtual_markers import FilledCapture
    from habitus.observe.simulated_markers import Faults


@dataclass(frozen=True)
class Markers:
    """Write the virtual markers of a body in motion, or a capture with its gaps filled from its
    fit.

    habitus markers results/walk/body.npz --layout mosh-67 --out walk67.c3d

    habitus markers results/walk/body.npz --fill walk.c3d --out walk_filled.c3d

    `docs/virtual-markers.md` describes the files.
    """

    source: Annotated[Path, tyro.conf.Positional, metavar("BODY.npz")]
    """A fit's body.npz, a motion that habitus wrote, or an npz in AMASS's style."""
    out: Annotated[Path, metavar("FILE.c3d|trc")]
    """Output file for the markers."""
    layout: Annotated[str | None, unset("NAME|FILE")] = None
    """Marker layout; by default the markers of the fit, at their estimated placements."""
    fill: Annotated[Path | None, unset("CAPTURE")] = None
    """The fitted capture: it is written with its gaps filled, and a table of these beside it."""
    noise: Annotated[float, metavar("MM")] = 0.0
    """Standard deviation of each coordinate of every sample."""
    placement: Annotated[float, metavar("MM")] = 0.0
    """Standard deviation of the markers' placement along the skin."""
    missing: Annotated[float, metavar("SHARE")] = 0.0
    """Share of samples that are missing, in gaps of 12 frames."""
    seed: Annotated[int, metavar("N")] = 0
    """Seed of the random faults."""
    body: Annotated[str | None, unset("FILE")] = None
    """The body model, where the file names no bundled one."""


OPTIONS = Markers
ABOUT = Markers.__doc__
NEEDS = ("habitus.jobs.virtual_markers",)


def run(options: Markers, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    console = console or screen()
    if options.fill is not None:
        _fill(options, console)
        return
    from habitus.jobs.virtual_markers import virtual_markers

    faults = _faults(options)
    virtual = virtual_markers(
        options.source,
        options.layout,
        faults=faults,
        seed=options.seed,
        body=options.body,
        out=options.out,
    )
    frames, markers = virtual.markers.shape[:2]
    say(console, virtual.warnings[0], "note")
    say(
        console,
        f"{frames} frames of {markers} virtual markers at {virtual.rate_hz:g} Hz, "
        f"{plain(options.out)}",
    )


def _faults(options: Markers) -> "Faults":
    from habitus.observe.simulated_markers import Faults

    for name in ("noise", "placement", "missing"):
        most = 1.0 if name == "missing" else 1e3
        if not 0 <= getattr(options, name) < most:
            raise HabitusError(
                f"--{name} {getattr(options, name):g}; expected 0 or more, below {most:g}"
            )
    return Faults(
        placement=1e-3 * options.placement, noise=1e-3 * options.noise, missing=options.missing
    )


def _fill(options: Markers, console: "Console") -> None:
    from habitus.jobs.virtual_markers import fill_capture

    if options.layout or options.noise or options.placement or options.missing:
        raise HabitusError(
            "--fill writes the capture's own markers; leave --layout, --noise, --placement, "
            "--missing out"
        )
    assert options.fill is not None
    result = fill_capture(options.source, options.fill, options.out, body=options.body)
    for line in _unfilled(result):
        say(console, line, "note")
    filled = int(result.filling.filled.sum())
    say(
        console,
        f"{filled} samples filled, {plain(options.out)}; every gap is in "
        f"{plain(options.out)}.filled.csv",
    )


def _unfilled(filled: "FilledCapture") -> list[str]:
    """What was not filled, a line a marker and reason."""
    gaps = filled.filling.gaps
    counts = Counter((gap.label, gap.why) for gap in gaps if gap.why)
    whole = Counter(gap.label for gap in gaps)
    return [
        f"{label}: {n} of {whole[label]} gaps stay empty: {why}"
        for (label, why), n in counts.items()
    ]


def left(options: Markers) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
