"""`habitus archive`: every capture below a folder, in as many processes as there are."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import FAILED_FIT, Strict, plain, progress_bar, say, screen
from habitus.errors import HabitusError, shown
from habitus.jobs.options import ArchiveOptions, metavar, unset

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.jobs.archive.run import Archive as Made
    from habitus.jobs.archive.run import Tally

_EVERY = 30.0
"""Seconds between two lines about progress where there is no terminal."""


@dataclass(frozen=True, kw_only=True)
class _Files:
    folder: Annotated[Path, tyro.conf.Positional, metavar("FOLDER")]
    """Where the captures are (C3D, TRC, Motive CSV, QTM TSV, npz), at any depth."""
    out: Annotated[Path, metavar("FOLDER")]
    """Folder for the results."""
    workers: Annotated[int | None, unset("N")] = None
    """Processes on this machine, one thread each; by default one per core."""
    cluster: Annotated[str | None, unset("ADDRESS")] = None
    """Dask scheduler (tcp://host:8786) whose machines share the work and see both folders under the
    same paths.
    """


@dataclass(frozen=True, kw_only=True)
class Archive(Strict, ArchiveOptions, _Files):
    """Fit thousands of captures: each subject's shape once, then its captures, in parallel.

    habitus archive captures --out results --subjects subjects.csv --workers 8

    OUT receives a folder for each capture, as deep as it lay, with what habitus mosh writes, and
    index.html, archive.parquet and archive.sqlite. The same command resumes a stopped run, and
    refits only what changed. A capture that fails is skipped and listed; the exit code is then 1.
    See `docs/archives.md`.
    """


OPTIONS = Archive
ABOUT = Archive.__doc__
NEEDS = ("habitus.jobs.archive.run", "rich.progress")


def run(options: Archive, console: "Console | None" = None) -> int:
    """Do what the options say; 1 where a capture could not be fitted, 3 under ``strict`` where a
    fit failed by its verdict. Raises HabitusError for bad input.
    """
    from habitus.jobs.archive.run import archive

    if options.workers is not None and options.cluster is not None:
        raise HabitusError(
            "--workers and --cluster were given; expected one: processes here, or a cluster's"
        )
    console = console or screen(options.quiet)
    with progress_bar(console) as bar:
        task = bar.add_task("read", total=1.0)
        lines = _Lines(console)

        def progress(tally: "Tally") -> None:
            bar.update(task, description=_progress_line(tally), completed=tally.share)
            lines(tally)

        made = archive(
            options.folder,
            options.out,
            options=options,
            workers=options.cluster or options.workers,
            progress=progress,
            on_failure=lambda path, reason: print(
                f"habitus: {shown(path, 300)}: {reason}", file=sys.stderr, flush=True
            ),
        )
    for line in _closing(made):
        say(console, line)
    if options.strict and made.levels.get("failed"):
        return FAILED_FIT
    return int(bool(made.failed))


class _Lines:
    """Progress in a pipe: a line now and then."""

    def __init__(self, console: "Console"):
        self._console = console
        self._last = time.monotonic()

    def __call__(self, tally: "Tally") -> None:
        if self._console.is_terminal or time.monotonic() - self._last < _EVERY:
            return
        self._last = time.monotonic()
        say(self._console, _progress_line(tally))


def _progress_line(tally: "Tally") -> str:
    """How far the run is, in words."""
    if tally.stage == "reading":
        return f"{tally.done} of {tally.captures} files read"
    words = f"{tally.done} of {tally.captures} captures"
    words += f", {tally.failed} failed" if tally.failed else ""
    return words if tally.seconds_left is None else f"{words}, {_duration(tally.seconds_left)} left"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    if minutes < 1:
        return "less than a minute"
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def _closing(made: "Made") -> list[str]:
    """What became of all captures."""
    done = made.fitted + made.kept
    words = (
        f"{done} capture{'' if done == 1 else 's'} of {made.subjects} "
        f"subject{'' if made.subjects == 1 else 's'}"
    )
    words += (
        f", {made.fitted} fitted now in {_duration(made.seconds)}"
        if made.kept
        else f" in {_duration(made.seconds)}"
    )
    words += f", {len(made.failed)} failed" if made.failed else ""
    words += f", {made.left_out} files that are no captures skipped" if made.left_out else ""
    levels = ", ".join(
        f"{made.levels[level]} {level}"
        for level in ("good", "doubtful", "failed")
        if level in made.levels
    )
    return [words, *([f"verdicts: {levels}"] if levels else []), f"results: {plain(made.page)}"]


def left(options: Archive) -> str:
    """What a stopped run leaves."""
    return "finished captures are complete; the same command resumes"
