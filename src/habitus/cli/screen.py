"""Output of commands: text from files made safe to show, lines that no pipe wraps."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from habitus.errors import shown
from habitus.jobs.options import Flag, unset

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

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
