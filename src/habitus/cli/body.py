"""`habitus body`: the body of a person from some measurements."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.errors import HabitusError
from habitus.jobs.options import unset

if TYPE_CHECKING:
    from rich.console import Console

_UNMET = 0.1  # weight below which a measurement is named: more than 2 % off
_RARE = 3.0  # standard deviations at which a person is worth a remark


@dataclass(frozen=True)
class Body:
    """Estimate the most likely body of a person with some measurements, and report the remaining
    uncertainty.

    Any subset of measurements will do; `docs/measurements.md` lists the names that --also takes.
    """

    height: Annotated[float | None, unset("METRES")] = None
    """From sole to crown."""
    weight: Annotated[float | None, unset("KG")] = None
    """Mass."""
    sex: Literal["neutral", "female", "male"] = "neutral"
    """Shape space of the body."""
    age: Annotated[float | None, unset("YEARS")] = None
    """Age of the person, where the body has ages."""
    chest: Annotated[float | None, unset("METRES")] = None
    """Circumference at the nipples."""
    waist: Annotated[float | None, unset("METRES")] = None
    """Circumference at the navel; a tailor's waist is --also waist_girth=."""
    hip: Annotated[float | None, unset("METRES")] = None
    """Circumference at the fullest buttocks."""
    inseam: Annotated[float | None, unset("METRES")] = None
    """From sole to crotch."""
    also: Annotated[tuple[str, ...], unset("NAME=VALUE …")] = ()
    """Other measurements in metres: hand_length=0.19 neck=0.38."""
    source: Annotated[
        Path | None, tyro.conf.arg(name="from", metavar="FILE", help_behavior_hint="")
    ] = None
    """Measurements of Seamly2D or Valentina (smis, vit), GarmentCode (yaml), FreeSewing (json) or
    `habitus measure` (json, csv); options given beside it go before them."""
    precision: Annotated[float | None, unset("SHARE")] = None
    """Standard deviation of a given measurement, as a share of it: 0.002, and 0.003 with --from."""
    body: Annotated[str | None, unset("FILE")] = None
    """Another body model than the bundled ones."""
    out: Annotated[Path | None, unset("FILE.npz|ply|obj|glb")] = None
    """File for the body: at rest as a mesh, or its betas (npz)."""


OPTIONS = Body
ABOUT = Body.__doc__
NEEDS = ("habitus.jobs.estimates",)
_SHORT = ("height", "weight", "chest", "waist", "hip", "inseam")


def run(options: Body, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from rich.table import Table

    from habitus.body.measurement_names import find_measurement, shown_unit
    from habitus.fit.from_measurements import ESTIMATE
    from habitus.jobs.estimates import (
        FROM_FILE,
        body_from_measurements,
        measurements_of,
        save_estimate,
    )

    console = console or screen()
    given = {
        name: getattr(options, name) for name in _SHORT if getattr(options, name) is not None
    } | _also(options.also)
    known, notes = measurements_of(options.source, options.sex) if options.source else ({}, ())
    full = {find_measurement(name): value for name, value in given.items()}
    if len(full) < len(given):
        full = given  # the same one twice, which is refused with both spellings
    settings = FROM_FILE if options.source else ESTIMATE
    if options.precision is not None:
        settings = replace(settings, precision=options.precision)
    estimate = body_from_measurements(
        sex=options.sex,
        age=options.age,
        body=options.body,
        settings=settings,
        **(known | full),
    )
    for note in notes:
        say(console, note, "note")
    if options.waist is not None and "natural_waist_circumference_m" not in full:
        say(
            console,
            "--waist is the girth at the navel; a tailor's waist is "
            f"--also waist_girth={options.waist:g}",
            "note",
        )
    table = Table(box=None, pad_edge=False)
    for heading in ("measurement", "value", "± sd", "given"):
        table.add_column(heading, justify="left" if heading == "measurement" else "right")
    for name, value in estimate.measurements.items():
        scale, unit = shown_unit(name)
        asked = ""
        if name in estimate.given:
            asked = f"{scale * estimate.given[name]:.1f} {unit}"
        table.add_row(
            name, f"{scale * value:.1f} {unit}", f"{scale * estimate.spread[name]:.1f}", asked
        )
    console.print(table)
    unmet = [name for name, weight in estimate.weights.items() if weight < _UNMET]
    if unmet:
        say(console, f"given, but not like any body with the others: {', '.join(unmet)}", "note")
    if estimate.sd_from_mean > _RARE:
        say(
            console,
            f"such a person is rare: {estimate.sd_from_mean:.1f} standard deviations from the mean",
            "note",
        )
    if options.out is not None:
        save_estimate(estimate, options.out)
        say(console, f"wrote {plain(options.out)}")


def _also(pairs: tuple[str, ...]) -> dict[str, float]:
    values = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        if name in ("sex", "age", "body", "settings"):
            raise HabitusError(f"--also {pair}: {name!r} is no measurement")
        try:
            values[name] = float(value)
        except ValueError:
            raise HabitusError(f"--also {pair}: expected NAME=VALUE, such as neck=0.38") from None
    return values


def left(options: Body) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
