"""How `habitus mosh` tells what became of captures: a line each in a pipe, a table on a terminal."""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from habitus.cli.screen import plain, say
from habitus.errors import shown

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.jobs.batch import Outcome

_WORDS = ("capture", "verdict", "page")
_COLOURS = {"good": "green", "doubtful": "yellow", "failed": "red"}


def tell(outcome: "Outcome", console: "Console") -> None:
    """Notes and, in a pipe, the result in one line; on stderr why there is none."""
    for warning in outcome.numbers.get("warnings", ()):
        say(console, f"{outcome.name}: {warning}", mark="note")
    if outcome.left_out:
        say(console, f"left out: {outcome.reason}", mark="note")
    elif outcome.failed:
        print(f"habitus: {outcome.reason}", file=sys.stderr, flush=True)
    elif not console.is_terminal:
        say(console, result_line(outcome))


def result_line(outcome: "Outcome") -> str:
    """Name, frames, markers, error, height, verdict, and the path of the page."""
    numbers = outcome.numbers
    facts = (
        f"{numbers['frames']} frames",
        f"{numbers['markers']} markers",
        f"error {_number(_errors(numbers).get('mean'), 1)} mm",
        f"height {_number(numbers['body_measurements'].get('height_m'), 2)} m",
        *filter(None, [verdict(numbers)]),
        str(_page(outcome)),
    )
    return f"{outcome.name}: {', '.join(facts)}"


def show(outcomes: Sequence["Outcome"], console: "Console") -> None:
    """The results as a table where the terminal is wide enough for it, else in a few lines each; nothing is cut."""
    done = [outcome for outcome in outcomes if outcome.folder is not None]
    if not done:
        return
    table = Table(box=None, pad_edge=False)
    for heading, _ in _cells(done[0]):
        table.add_column(
            heading, justify="left" if heading in ("capture", "verdict", "page") else "right", no_wrap=True
        )
    for outcome in done:
        table.add_row(*(_coloured(heading, text) for heading, text in _cells(outcome)))
    if console.measure(table, options=console.options.update(width=1 << 16)).maximum <= console.width:
        console.print(table)
        return
    for outcome in done:
        (_, name), *cells, (_, page) = _cells(outcome)
        console.print(f"[bold]{plain(name)}[/]", soft_wrap=True, highlight=False)
        facts = (f"{heading} {_coloured(heading, text)}" for heading, text in cells if text)
        console.print(f"  {', '.join(facts)}", overflow="fold", highlight=False)
        say(console, f"  {page}")


def _cells(outcome: "Outcome") -> Iterator[tuple[str, str]]:
    """What the table says of a capture, under its headings."""
    numbers, body = outcome.numbers, outcome.numbers["body_measurements"]
    errors, held = _errors(numbers), _last(numbers.get("held_out_error_mm") or {})
    yield "capture", outcome.name
    yield "verdict", verdict(numbers)
    yield "frames", str(numbers["frames"])
    yield "markers", str(numbers["markers"])
    yield "error mm", _number(errors.get("mean"), 1)
    yield "p95 mm", _number(errors.get("p95"), 1)
    yield "held out mm", _number(held["mean"], 1) if held else ""
    yield "height m", _number(body.get("height_m"), 2)
    yield "mass kg", _number(body.get("mass_kg"), 1)
    yield "suspects", str(len(numbers["suspect_markers"]))
    yield "seconds", _number(numbers["stage_seconds"].get("total"), 1)
    yield "page", str(_page(outcome))


def verdict(numbers: "Any") -> str:
    """The fit's verdict in a word, "" where it has none."""
    return str((numbers.get("verdict") or {}).get("level", ""))


def closing(outcomes: Sequence["Outcome"], out: Path) -> str:
    """How many captures were fitted and how many were not."""
    failed = sum(outcome.failed for outcome in outcomes)
    left_out = sum(outcome.left_out for outcome in outcomes)
    told = f"{sum(outcome.folder is not None for outcome in outcomes)} captures fitted"
    told += f", {failed} failed" if failed else ""
    told += f", {left_out} other files left out" if left_out else ""
    return f"{told}; results lie in {out}"


def exit_code(outcomes: Sequence["Outcome"]) -> int:
    """1 where a capture failed, else 0."""
    return int(any(outcome.failed for outcome in outcomes))


def _page(outcome: "Outcome") -> Path:
    assert outcome.folder is not None
    page = outcome.folder / "report.html"
    here = Path.cwd()
    return page.relative_to(here) if page.is_relative_to(here) else page


def _errors(numbers: "Any") -> "Any":
    return _last(numbers["marker_error_mm"]) or {}


def _last(stages: "Any") -> "Any":
    return stages.get("soft_tissue") or stages.get("pose")


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _coloured(heading: str, text: str) -> str:
    colour = _COLOURS.get(text) if heading == "verdict" else None
    return f"[{colour}]{text}[/]" if colour else plain(shown(text, 1 << 16))
