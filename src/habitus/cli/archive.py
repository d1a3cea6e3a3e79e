"""`habitus archive`: every capture below a folder, in as many processes as there are."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import Flag, plain, progress_bar, say, screen, unset
from habitus.errors import HabitusError, shown

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.jobs.archive.run import Archive as Made
    from habitus.jobs.archive.run import Tally
    from habitus.jobs.mosh import Mosh

_EVERY = 30.0
"""Seconds between two lines about progress where there is no terminal."""


@dataclass(frozen=True)
class Archive:
    """Fit thousands of captures: each subject's shape once, then its captures, in parallel.

    habitus archive captures --out results --subjects subjects.csv --workers 8

    OUT receives a folder a capture, as deep as it lay, with what habitus mosh writes, and
    index.html, archive.parquet and archive.sqlite. The same command goes on where a run stopped,
    and fits again only what changed. A bad capture is told and left behind; the exit code is then
    1. `docs/archives.md` tells the rest.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Where the captures are (C3D, TRC, Motive CSV, QTM TSV, npz), at any depth."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results."""
    subjects: Annotated[Path | None, unset("TABLE.csv")] = None
    """Whose captures are whose: columns capture (a file or folder below FOLDER) and subject; by
    itself, the files' subjects and folders.
    """
    workers: Annotated[int | None, unset("N")] = None
    """Processes on this machine, one thread each; as many as it has cores by itself."""
    cluster: Annotated[str | None, unset("ADDRESS")] = None
    """A Dask scheduler (tcp://host:8786) whose machines share the work, and see both folders under
    the same paths.
    """
    layout: Annotated[str, tyro.conf.arg(metavar="auto|discover|NAME|FILE")] = "auto"
    """Which marker sits where; see habitus mosh."""
    body: Annotated[str, tyro.conf.arg(metavar="default|FILE")] = "default"
    """The body model."""
    sex: Literal["neutral", "female", "male", "auto"] = "neutral"
    """Which model of the body; "auto": for each subject the sex that the files say or a neutral fit
    is sure of.
    """
    age: Annotated[str | None, unset("YEARS|auto")] = None
    """How old the people are; "auto" takes what the files say."""
    joints: Literal["auto", "smpl", "smplh", "smplx"] = "auto"
    """Which joints the body has."""
    soft_tissue: Literal["shape", "dynamics", "both"] = "shape"
    """What soft tissue moves along in the last stage."""
    no_soft_tissue: Flag = False
    """Stop after the pose stage."""
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second, where files do not say or say it wrong."""
    minimal: Flag = False
    """Of each capture only body.npz and metrics.json: no page, no animated mesh; a third of the
    room.
    """
    npz_style: Literal["habitus", "amass"] = "habitus"
    """What body.npz looks like."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Seed of what is drawn at random."""
    strict: Flag = False
    """End with exit code 3 where any fit has failed by its verdict."""
    quiet: Flag = False
    """Print nothing but errors."""


OPTIONS = Archive
ABOUT = Archive.__doc__
NEEDS = ("habitus.jobs.archive.run", "rich.progress")
FAILED_FIT = 3


def run(options: Archive, console: "Console | None" = None) -> int:
    """Do what the options say; 1 where a capture could not be fitted, 3 under ``strict`` where a
    fit failed by its verdict. Raises HabitusError for bad input.
    """
    from habitus.jobs.archive.run import archive

    if options.workers is not None and options.cluster is not None:
        raise HabitusError(
            "--workers is about this machine and --cluster about others; give one of them"
        )
    console = console or screen(options.quiet)
    with progress_bar(console) as bar:
        task = bar.add_task("read", total=1.0)
        lines = _Lines(console)

        def progress(tally: "Tally") -> None:
            bar.update(task, description=_told(tally), completed=tally.share)
            lines(tally)

        made = archive(
            options.folder,
            options.out,
            subjects=options.subjects,
            mosh=_recipe(options),
            body=options.body,
            workers=options.cluster or options.workers,
            minimal=options.minimal,
            npz_style=options.npz_style,
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
        say(self._console, _told(tally))


def _recipe(options: Archive) -> "Mosh":
    from habitus.jobs.mosh import Mosh

    return Mosh(
        options.layout,
        sex=options.sex,
        soft_tissue=False if options.no_soft_tissue else options.soft_tissue,
        fps=options.fps,
        joints=options.joints,
        seed=options.seed,
        age=options.age,
    )


def _told(tally: "Tally") -> str:
    """How far it is, in words."""
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
    """What became of all."""
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
    words += f", {made.left_out} files that are no captures left out" if made.left_out else ""
    levels = ", ".join(
        f"{made.levels[level]} {level}"
        for level in ("good", "doubtful", "failed")
        if level in made.levels
    )
    return [words, *([f"verdicts: {levels}"] if levels else []), f"all of them: {plain(made.page)}"]


def left(options: Archive) -> str:
    """What a run that was stopped has left."""
    return "captures that were finished are whole; the same command goes on"
