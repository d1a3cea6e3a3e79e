"""`habitus measure`: what a person measures."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.jobs.options import metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Measure:
    """Measure a person: height, mass, circumferences, breadths, depths and lengths, by their
    standard names.

    The person is measured upright at rest, or seated, whatever pose the file has; a mesh must be
    at rest. `docs/measurements.md` defines each measurement.
    """

    source: Annotated[str, tyro.conf.Positional, metavar("FILE|default")]
    """A fit's body.npz, a body model (npz, pkl, "default"), or a mesh (ply, obj) in metres, y up.
    """
    body: Annotated[str | None, unset("NAME|FILE")] = None
    """The body that betas or mesh belong to, where the file does not name it."""
    posture: Literal["standing", "seated"] = "standing"
    """seated: ISO 7250-1's seated dimensions, hips, knees and elbows at 90 degrees."""
    out: Annotated[Path | None, unset("FILE.json|csv|smis|vit|yaml")] = None
    """File for the measurements; for Seamly2D or Valentina (smis, vit) or GarmentCode (yaml)."""
    format: Literal["auto", "habitus", "seamly", "garmentcode", "freesewing"] = "auto"
    """Program for which --out is written; auto goes by its ending, and json is habitus'."""
    segments: Annotated[Path | None, unset("FILE.csv|json")] = None
    """File for volume, mass, centre of mass and inertia of each segment."""
    picture: Annotated[Path | None, unset("FILE.svg")] = None
    """File for a drawing of the person with every tape."""


OPTIONS = Measure
ABOUT = Measure.__doc__
NEEDS = ("habitus.jobs.measuring",)


def run(options: Measure, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from rich.table import Table

    from habitus.body.measurement_names import shown_measurement
    from habitus.jobs.measuring import measure_file

    console = console or screen()
    measured = measure_file(options.source, options.body, options.posture)
    table = Table(box=None, pad_edge=False)
    for heading in ("measurement", "value", "what", "ISO"):
        table.add_column(
            heading, justify="right" if heading == "value" else "left", no_wrap=heading != "what"
        )
    for name, value in measured.values.items():
        what = measured.definitions[name]
        table.add_row(name, shown_measurement(name, value), what.says, what.iso)
    console.print(table)
    for note in measured.notes:
        say(console, note, "note")
    if options.out is not None:
        measured.save(options.out, "" if options.format == "auto" else options.format)
        say(console, f"wrote {plain(options.out)}")
    if options.segments is not None:
        measured.save_segments(options.segments)
        say(console, f"wrote {plain(options.segments)}")
    if options.picture is not None:
        measured.draw(options.picture)
        say(console, f"drew {plain(options.picture)}")


def left(options: Measure) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
