"""`habitus mosh`: from capture files to moving bodies."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.first_run import told_of_compilation
from habitus.cli.screen import Flag, progress_bar, say, screen, unset
from habitus.errors import shown

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.jobs.batch import Outcome
    from habitus.types import Progress


@dataclass(frozen=True)
class Mosh:
    """Fit a body to motion captures: shape, pose in every frame, soft tissue, and where each marker
    sat.

    Several files are one subject. Of a folder every capture below it is fitted; those in one folder
    that name the same subject and have their markers at the same places are one subject. For each,
    OUT/<capture's name>/ receives body.npz (AMASS keys), body.glb (animated mesh), metrics.json and
    report.html (opens offline in a browser). Of several captures a bad one is told and left behind;
    the exit code is then 1.
    """

    captures: Annotated[
        tuple[Path, ...], tyro.conf.Positional, unset("CAPTURE|FOLDER [CAPTURE|FOLDER …]")
    ]
    """C3D, TRC, Motive CSV, QTM TSV or npz files of one subject; or folders."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results."""
    layout: Annotated[str, tyro.conf.arg(metavar="auto|discover|NAME|FILE")] = "auto"
    """Which marker sits where; "auto" picks a layout by the capture's labels, "discover" finds the
    places of labels that nobody wrote down by fitting, and writes layout.toml.
    """
    label: Literal["given", "auto"] = "given"
    """Whose labels: the file's, or "auto": found, whatever the file calls its points (see habitus
    label).
    """
    body: Annotated[str, tyro.conf.arg(metavar="default|FILE")] = "default"
    """The body model: the one that habitus brings along, or an SMPL-family file (npz, pkl)."""
    sex: Literal["neutral", "female", "male", "auto"] = "neutral"
    """Which model of the body; "auto" fits the neutral one first and takes the sex that it is sure
    of.
    """
    age: Annotated[str | None, unset("YEARS|auto")] = None
    """How old the person is, 5 to 80; "auto" takes what the capture's file says. A grown person
    without it.
    """
    joints: Literal["auto", "smpl", "smplh", "smplx"] = "auto"
    """Which joints it has: 24, 52 with fingers, 55 with jaw and eyes, too; "auto" takes fingers
    where markers sit on them.
    """
    soft_tissue: Literal["shape", "dynamics", "both"] = "shape"
    """What soft tissue moves along in the last stage: directions of shape, the body's dynamic blend
    shapes, or both.
    """
    no_soft_tissue: Flag = False
    """Stop after the pose stage."""
    causal: Flag = False
    """Solve frame after frame, never looking ahead, as a live system would (no soft tissue)."""
    hold_out: Annotated[tuple[str, ...], unset("L1 L2 …")] = ()
    """Leave these markers out of everything and report their error where one expects them."""
    hold_out_every: Annotated[int | None, unset("K")] = None
    """Do so for every marker, one in K at a time (K further fits)."""
    placements_from: Annotated[tuple[Path, ...], unset("CAPTURE …")] = ()
    """Other captures of the same person and markers: report the held-out markers' error also at the
    places that these tell.
    """
    subject: Annotated[str | None, unset("NAME")] = None
    """Which person, where a capture holds several; otherwise each is fitted by itself."""
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second, where the file does not say or says it wrong."""
    obj: Flag = False
    """Write an OBJ mesh a frame as well."""
    npz_style: Literal["habitus", "amass"] = "habitus"
    """What body.npz looks like: all that was found, or what AMASS scripts slice (docs/amass.md)."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Seed of what is drawn at random (the choice of frames)."""
    strict: Flag = False
    """End with exit code 3 where any fit has failed by its verdict."""
    quiet: Flag = False
    """Print nothing but errors."""


OPTIONS = Mosh
ABOUT = Mosh.__doc__
NEEDS = ("habitus.jobs.batch", "habitus.cli.mosh_results", "rich.progress", "numba.core.event")


def run(options: Mosh, console: "Console | None" = None) -> int:
    """Do what the options say; 1 where one of several captures failed, 3 under ``strict`` where a
    fit failed by its verdict. Raises HabitusError for bad input.
    """
    from habitus.cli.mosh_results import closing, exit_code, show, tell

    console = console or screen(options.quiet)
    several = len(options.captures) > 1 or any(path.is_dir() for path in options.captures)
    at_once = several and not console.is_terminal  # a table and a bar want the end
    with told_of_compilation(options.quiet), progress_bar(console) as bar:
        task = bar.add_task("read", total=1.0)
        outcomes = _fit(
            options,
            lambda stage, share: bar.update(task, description=shown(stage), completed=share),
            (lambda outcome: tell(outcome, console)) if at_once else (lambda outcome: None),
        )
    if not several and all(outcome.error for outcome in outcomes):
        raise next(outcome.error for outcome in outcomes if outcome.error)
    for outcome in () if at_once else outcomes:
        tell(outcome, console)
    if console.is_terminal:
        show(outcomes, console)
    if several:
        say(console, closing(outcomes, options.out))
    return exit_code(outcomes, options.strict)


def _fit(
    options: Mosh, progress: "Progress", on_done: "Callable[[Outcome], None]"
) -> "list[Outcome]":
    from habitus.jobs.batch import FitOptions, fit_all
    from habitus.jobs.mosh import Mosh as Recipe

    recipe = Recipe(
        options.layout,
        sex=options.sex,
        soft_tissue=False if options.no_soft_tissue else options.soft_tissue,
        causal=options.causal,
        subject=options.subject,
        fps=options.fps,
        joints=options.joints,
        seed=options.seed,
        age=options.age,
        label=options.label,
    )
    asked = FitOptions(
        options.hold_out,
        options.hold_out_every,
        options.obj,
        options.npz_style,
        options.placements_from,
    )
    return fit_all(
        recipe,
        options.captures,
        options.out,
        options.body,
        asked,
        progress=progress,
        on_done=on_done,
    )


def left(options: Mosh) -> str:
    """What a run that was stopped has left."""
    return "captures that were finished are whole"
