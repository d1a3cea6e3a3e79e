"""Output of commands: text from files made safe to show, lines that no pipe wraps, a notice of
compilation, and the outcomes of captures, a line each in a pipe, a table on a terminal.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TextIO

from habitus.errors import shown
from habitus.jobs.options import Flag, unset

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from habitus.jobs.batch import Outcome


_ENDLESS = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Of commands whose work is shared by threads, or by a cluster."""

    workers: Annotated[int | None, unset("N")] = None
    """Threads to work with; by default one per core."""
    cluster: Annotated[str | None, unset("ADDRESS")] = None
    """Work on the Dask cluster whose scheduler has this address (tcp://host:8786), which must be
    trusted.
    """

    @property
    def shared_by(self) -> int | str | None:
        """As functions take it."""
        return self.workers if self.cluster is None else self.cluster


@dataclass(frozen=True, kw_only=True)
class Quiet:
    """Of every command that prints."""

    quiet: Flag = False
    """Print nothing but errors."""


@dataclass(frozen=True, kw_only=True)
class Strict(Quiet):
    """Of commands whose results have a verdict."""

    strict: Flag = False
    """Exit with code 3 if any fit is judged failed."""


def screen(quiet: bool = False) -> "Console":
    """Where a command prints: a terminal, or a pipe or file, where lines are as long as they
    are.
    """
    import sys

    from rich.console import Console

    class Screen(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    return Screen(quiet=quiet, width=None if sys.stdout.isatty() else _ENDLESS)


def progress_bar(console: "Console", patience: float | None = None) -> "Progress":
    """A bar on a terminal, nothing in a pipe; with the time left where steps take turns within
    ``patience`` seconds.
    """
    from rich import progress as rich

    columns = [
        rich.TextColumn("{task.description}", markup=False),
        rich.BarColumn(),
        rich.TimeElapsedColumn(),
    ]
    if patience is not None:
        columns += [rich.TaskProgressColumn(), rich.TextColumn("left"), rich.TimeRemainingColumn()]
    return rich.Progress(
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
        speed_estimate_period=patience or 30.0,
    )


def say(console: "Console", text: str, mark: str = "") -> None:
    """One line, whatever the text holds: control characters as escapes, no markup; ``mark`` is a
    word before it.
    """
    from rich.text import Text

    line = Text.assemble((f"{mark} ", "yellow") if mark else "", shown(text, _ENDLESS))
    console.print(line, soft_wrap=True, highlight=False)


def plain(text: object) -> str:
    """A text for a table or a line with rich's markup: shown as it is."""
    from rich.markup import escape

    return escape(shown(text, _ENDLESS))


NOTICE = "habitus: compiling kernels for this machine, once: about 15 s"


@contextmanager
def compilation_notice(quiet: bool = False) -> Iterator[None]:
    """One line on stderr when a first kernel is compiled inside the block; later runs load kernels
    and say nothing.
    """
    if quiet:
        yield
        return
    from numba.core import event

    with event.install_listener("numba:compile", _once(sys.stderr)):
        yield


def _once(stream: TextIO) -> object:
    """Tells `stream`; on a terminal what stands in its place by then, so that a progress bar stays
    whole.
    """
    from numba.core.event import Listener

    class Once(Listener):
        printed = False

        def on_start(self, event: object) -> None:
            if not self.printed:
                self.printed = True
                print(NOTICE, file=sys.stderr if stream.isatty() else stream, flush=True)

        def on_end(self, event: object) -> None:
            pass

    return Once()


FAILED_FIT = 3
_WORDS = ("capture", "verdict", "page")
_COLOURS = {"good": "green", "doubtful": "yellow", "failed": "red"}


def print_outcome(outcome: "Outcome", console: "Console") -> None:
    """Notes, why a fit is not good and, in a pipe, the result in one line; on stderr why there is
    none.
    """
    for warning in outcome.numbers.get("warnings", ()):
        say(console, f"{outcome.name}: {warning}", mark="note")
    if verdict_level(outcome.numbers) not in ("", "good"):
        reasons = " ".join(outcome.numbers["verdict"]["reasons"])
        say(console, f"{outcome.name}: {reasons}", mark=verdict_level(outcome.numbers))
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
        *filter(None, [verdict_level(numbers)]),
        str(_page(outcome)),
    )
    return f"{outcome.name}: {', '.join(facts)}"


def print_table(outcomes: Sequence["Outcome"], console: "Console") -> None:
    """The results as a table where the terminal is wide enough for it, else in a few lines each;
    nothing is cut.
    """
    done = [list(_facts(outcome)) for outcome in outcomes if outcome.folder is not None]
    if not done:
        return
    kept = [
        k for k, column in enumerate(zip(*done, strict=True)) if any(fact.text for fact in column)
    ]
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for fact in (done[0][k] for k in kept):
        heading = f"{fact.heading} {fact.unit}".strip()
        table.add_column(
            heading, justify="left" if fact.heading in _WORDS else "right", no_wrap=True
        )
    for facts in done:
        table.add_row(*(_coloured(facts[k]) for k in kept))
    if (
        console.measure(table, options=console.options.update(width=1 << 16)).maximum
        <= console.width
    ):
        console.print(table)
        return
    for name, *facts, page in done:
        console.print(f"[bold]{plain(name.text)}[/]", soft_wrap=True, highlight=False)
        lines = (
            f"{fact.heading} {_coloured(fact)} {fact.unit}".strip() for fact in facts if fact.text
        )
        console.print(f"  {', '.join(lines)}", overflow="fold", highlight=False)
        say(console, f"  {page.text}")


class _Fact(NamedTuple):
    """What is said of a capture in the table's column of that heading; the text is empty where
    there is nothing.
    """

    heading: str
    text: str
    unit: str = ""


def _facts(outcome: "Outcome") -> Iterator[_Fact]:
    numbers = outcome.numbers
    body = outcome.numbers["body_measurements"]
    errors = _errors(numbers)
    held = _last(numbers.get("held_out_error_mm") or {})
    yield _Fact("capture", outcome.name)
    yield _Fact("verdict", verdict_level(numbers))
    yield _Fact("frames", str(numbers["frames"]))
    yield _Fact("markers", str(numbers["markers"]))
    yield _Fact("error", _number(errors.get("mean"), 1), "mm")
    yield _Fact("p95", _number(errors.get("p95"), 1), "mm")
    yield _Fact("held out", _number(held["mean"], 1) if held else "", "mm")
    known = _last(numbers.get("held_out_known_placement_mm") or {})
    if known:
        yield _Fact("held out, known placement", _number(known["mean"], 1), "mm")
    yield _Fact("height", _number(body.get("height_m"), 2), "m")
    yield _Fact("mass", _number(body.get("mass_kg"), 1), "kg")
    yield _Fact("suspects", str(len(numbers["suspect_markers"])))
    yield _Fact("time", _number(numbers["stage_seconds"].get("total"), 1), "s")
    yield _Fact("page", str(_page(outcome)))


def verdict_level(numbers: "Any") -> str:
    """The fit's verdict in a word, "" where it has none."""
    return str((numbers.get("verdict") or {}).get("level", ""))


def closing(outcomes: Sequence["Outcome"], out: Path) -> str:
    """How many captures were fitted and how many were not."""
    failed = sum(outcome.failed for outcome in outcomes)
    left_out = sum(outcome.left_out for outcome in outcomes)
    done = sum(outcome.folder is not None for outcome in outcomes)
    text = f"{done} capture{'' if done == 1 else 's'} fitted"
    text += f", {failed} failed" if failed else ""
    text += f", {left_out} that are no captures skipped" if left_out else ""
    return f"{text}; results are in {out}"


def exit_code(outcomes: Sequence["Outcome"], strict: bool = False) -> int:
    """1 where a capture could not be fitted, else 0; if ``strict``, 3 where a fit has failed by its
    verdict.
    """
    if strict and any(verdict_level(outcome.numbers) == "failed" for outcome in outcomes):
        return FAILED_FIT
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


def _coloured(fact: _Fact) -> str:
    colour = _COLOURS.get(fact.text) if fact.heading == "verdict" else None
    return f"[{colour}]{fact.text}[/]" if colour else plain(fact.text)
