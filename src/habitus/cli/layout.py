"""`habitus layout show | check | new`: which marker sits where."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from habitus.cli.screen import plain, say, screen
from habitus.errors import HabitusError
from habitus.files import write_text
from habitus.io.captures.read import Capture, read_capture
from habitus.io.layouts.draft import draft_layout
from habitus.io.layouts.files import load_layout, match_layout, shipped_layouts
from habitus.jobs.options import Flag, unset
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.matching import LayoutMatch


@dataclass(frozen=True)
class Show:
    """List the marker layouts, show one marker by marker, or list the landmarks for
    markers.
    """

    layout: Annotated[str | None, tyro.conf.Positional, unset("NAME|FILE")] = None
    """A layout's name or file; without it, all layouts that come with habitus."""
    landmarks: Flag = False
    """List the body's landmarks instead."""
    body: str = "default"
    """The body whose landmarks are listed: "default" or a model file."""


@dataclass(frozen=True)
class Check:
    """Check a layout (or "auto") against a capture: labels, placements, and their geometry."""

    layout: Annotated[str, tyro.conf.Positional]
    """A layout's name or file, or "auto" to choose by the capture's labels."""
    capture: Annotated[Path, tyro.conf.Positional]
    """The capture file."""
    subject: Annotated[str | None, unset("NAME")] = None
    """Person, where the capture holds several."""
    body: str = "default"
    """The body that the landmarks are looked up on: "default" or a model file."""


@dataclass(frozen=True)
class New:
    """Draft a layout file from a capture's labels: known ones filled in, unknown ones as TODO
    lines.
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """The capture file."""
    out: Path
    """The layout file to write (.toml)."""
    name: Annotated[str | None, unset("NAME")] = None
    """The layout's name; by default that of the file."""
    subject: Annotated[str | None, unset("NAME")] = None
    """Person, where the capture holds several."""
    overwrite: Flag = False
    """Write even where the file exists."""


OPTIONS = (
    Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[New, tyro.conf.subcommand("new")]
)
ABOUT = "Show marker layouts, check one against a capture, draft a new one."
NEEDS = ("habitus.io.layouts.files",)


def run(options: Show | Check | New, console: Console | None = None) -> None:
    """Do what the options say and print it. Raises HabitusError for bad input."""
    console = console or screen()
    if isinstance(options, New):
        _new(options, console)
    elif isinstance(options, Check):
        _check(options, console)
    elif options.landmarks:
        _show_landmarks(options.body, console)
    elif options.layout is None:
        _show_all(console)
    else:
        _show_one(load_layout(options.layout), console)


def left(options: Show | Check | New) -> str:
    """What a stopped run leaves."""
    return "nothing was written"


# -- show ------------------------------------------------------------------------------------------


def _show_all(console: Console) -> None:
    table = _table("name", ">markers", ">extras", "what")
    for layout in shipped_layouts():
        extras = sum(marker.optional for marker in layout.markers)
        count = len(layout) - extras
        table.add_row(plain(layout.name), str(count), str(extras or ""), plain(layout.title))
    console.print(table)


def _show_one(layout: MarkerLayout, console: Console) -> None:
    console.print(f"[bold]{plain(layout.name)}[/]  {plain(layout.title)}", highlight=False)
    if layout.also_known_as:
        say(console, f"also known as {', '.join(layout.also_known_as)}")
    if layout.description:
        say(console, " ".join(layout.description.split()))
    table = _table(
        "label", "place", ">off skin mm", ">± mm", ">place ± mm", "extra", "also spelled"
    )
    for marker in layout.markers:
        table.add_row(
            *map(plain, _row(marker)),
            "yes" if marker.optional else "",
            plain(", ".join(marker.aliases)),
        )
    console.print(table)
    for label, why in layout.left_out.items():
        console.print(f"{plain(label)} is left out: {plain(why)}", highlight=False)
    for source in layout.sources:
        console.print(f"source: {plain(source)}", highlight=False)


def _row(marker: Marker) -> tuple[str, ...]:
    lengths = (marker.distance, marker.distance_spread, marker.place_spread)
    return (marker.label, marker.place, *(f"{length * 1e3:.4g}" for length in lengths))


def _show_landmarks(body_name: str, console: Console) -> None:
    body = _body(body_name)
    midline = sorted(name for name in body.landmarks if not name.startswith(("left_", "right_")))
    pairs = sorted(
        name.removeprefix("left_") for name in body.landmarks if name.startswith("left_")
    )
    console.print(f"[bold]midline[/]: {', '.join(midline)}", highlight=False)
    console.print(f"[bold]left_… and right_…[/]: {', '.join(pairs)}", highlight=False)


# -- check -----------------------------------------------------------------------------------------


def _check(options: Check, console: Console) -> None:
    capture = read_capture(options.capture, options.subject)
    given = None if options.layout == "auto" else [load_layout(options.layout)]
    match = match_layout(capture.labels, capture.markers, given)
    vertices = match.layout.vertices(_body(options.body))
    console.print(
        f"[bold]{plain(capture.name)}[/] with [bold]{plain(match.layout.name)}[/]: "
        f"{len(match.matched)} of "
        f"{len(capture.labels)} labels matched, confidence {match.confidence:.2f}",
        highlight=False,
    )
    _print_matched(capture, match, vertices, console)
    for label in match.unmatched_labels:
        reason = match.left_out.get(label, "not in the layout")
        console.print(f"not used: {plain(label)} ({plain(reason)})", highlight=False)
    if match.missing_labels:
        console.print(
            f"not in the capture: {plain(', '.join(match.missing_labels))}", highlight=False
        )
    for correction in match.corrections:
        console.print(
            f"{'' if correction.quiet else '[yellow]warning[/]: '}{plain(correction.text)}",
            highlight=False,
        )


def _print_matched(
    capture: Capture, match: LayoutMatch, vertices: np.ndarray, console: Console
) -> None:
    table = _table("label", "place", ">off skin mm", ">± mm", ">place ± mm", ">vertex", ">seen")
    seen = np.isfinite(match.select(capture.markers)[..., 0]).mean(axis=0)
    for marker, vertex, share in zip(match.layout.markers, vertices, seen, strict=True):
        table.add_row(*map(plain, _row(marker)), str(vertex), f"{share:.0%}")
    console.print(table)


# -- new -------------------------------------------------------------------------------------------


def _new(options: New, console: Console) -> None:
    if options.out.suffix.lower() != ".toml":
        raise HabitusError(
            f"cannot write a layout to {options.out}: expected a file name that ends in .toml"
        )
    if options.out.exists() and not options.overwrite:
        raise HabitusError(f"{options.out} exists; choose another name or add --overwrite")
    capture = read_capture(options.capture, options.subject)
    name = options.name or options.out.stem
    text = draft_layout(name, capture.name, capture.labels, capture.markers, shipped_layouts())
    write_text(options.out, text)
    todo = sum(line.startswith("# TODO ") for line in text.splitlines())
    console.print(
        f"wrote {plain(str(options.out))}: {len(capture.labels)} labels, {todo} to do",
        highlight=False,
    )


# -- helpers ---------------------------------------------------------------------------------------


def _body(name: str):
    from habitus.io.models.bodies import load_body  # torch loads with it: not for `show`

    return load_body(name)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in columns:
        right = column.startswith(">")
        table.add_column(
            column.lstrip(">"),
            justify="right" if right else "left",
            no_wrap=right or column == "name",
        )
    return table
