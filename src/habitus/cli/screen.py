"""What commands say: text from files as it may be shown, lines that no pipe wraps, help without
noise.
"""

from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.errors import shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
"""An option that is there or not."""
_ENDLESS = 1 << 16


def unset(metavar: str) -> object:
    """For options that say nothing unless they are given: no default is told in the help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


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
