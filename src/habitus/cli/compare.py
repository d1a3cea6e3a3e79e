"""`habitus compare`: two results of one capture side by side."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.jobs.options import metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Compare:
    """Compare two results of one capture: two fits with other options, or those of two tools.

    habitus compare results/walk other/walk --out compared

    habitus compare results/walk soma/walk.npz --body-b smplh.npz

    Reports the distances of skins, joints, their rotations, markers, shapes and measurements, and
    the times of the largest. With --out it writes compare.html, both bodies on one clock, side by
    side or overlaid (opens offline in a browser), and compare.json. `docs/comparing.md` explains
    the numbers.
    """

    a: Annotated[Path, tyro.conf.Positional, metavar("A")]
    """A folder that habitus mosh wrote, its body.npz, or an npz in AMASS's style."""
    b: Annotated[Path, tyro.conf.Positional, metavar("B")]
    """The other one."""
    out: Annotated[Path | None, unset("FOLDER")] = None
    """Folder for compare.html and compare.json."""
    offset: Annotated[float, metavar("SECONDS")] = 0.0
    """Time from A's first frame to B's."""
    align: Literal["auto", "rigid", "none"] = "auto"
    """Rigid alignment of B: where the world frames clearly differ, always, or never."""
    body_a: Annotated[str | None, unset("FILE")] = None
    """The body model of A, where it names no bundled one."""
    body_b: Annotated[str | None, unset("FILE")] = None
    """The body model of B."""


OPTIONS = Compare
ABOUT = Compare.__doc__
NEEDS = ("habitus.jobs.comparing",)


def run(options: Compare, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from rich.table import Table

    from habitus.jobs.comparing import compare

    console = console or screen()
    comparison = compare(
        options.a,
        options.b,
        out=options.out,
        body_a=options.body_a,
        body_b=options.body_b,
        offset=options.offset,
        align=options.align,
    )
    for letter, name in zip("AB", comparison.names, strict=True):
        say(console, f"{letter}: {name}")
    for note in comparison.notes:
        say(console, note, "note")
    table = Table(box=None, pad_edge=False)
    for heading in ("", "mean", "95 % below", "most"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for row in comparison.rows():
        table.add_row(*row)
    console.print(table)
    for moment in comparison.numbers["worst_moments"][:3]:
        joint = plain(moment["worst_joint"]).replace("_", " ")
        say(
            console,
            f"{moment['time_s']:.2f} s: {moment['mean_mm']:.1f} mm apart, {joint} "
            f"{moment['worst_joint_mm']:.0f} mm",
        )
    if options.out is not None:
        say(console, f"wrote {plain(options.out / 'compare.html')}")


def left(options: Compare) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
