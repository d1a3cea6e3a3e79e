"""`habitus mosh`: from capture files to moving bodies."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.first_run import told_of_compilation

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from habitus.fit.mosh.result import MarkerFit


@dataclass(frozen=True)
class Mosh:
    """Fit a body to motion captures: shape, pose in every frame, soft tissue, and where each marker sat.

    Several captures are one subject. For each, OUT/<capture's name>/ receives body.npz (AMASS keys), body.glb (animated
    mesh), metrics.json and report.html (opens offline in a browser).
    """

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE [CAPTURE …]")]
    """C3D, TRC, Motive CSV, QTM TSV or npz files of one subject."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results."""
    layout: Annotated[str, tyro.conf.arg(metavar="auto|NAME|FILE")] = "auto"
    """Which marker sits where; "auto" picks a layout by the capture's labels."""
    body: Annotated[str, tyro.conf.arg(metavar="default|FILE")] = "default"
    """The body model: the one that habitus brings along, or an SMPL-family file (npz, pkl)."""
    gender: Literal["neutral", "female", "male", "auto"] = "neutral"
    """Which model of the body, where it has several; "auto" estimates from the markers."""
    no_soft_tissue: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Stop after the pose stage."""
    causal: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Solve frame after frame, never looking ahead, as a live system would (no soft tissue)."""
    hold_out: Annotated[tuple[str, ...], tyro.conf.arg(metavar="L1 L2 …")] = ()
    """Leave these markers out of everything and report their error at the layout's default place."""
    hold_out_every: Annotated[int | None, tyro.conf.arg(metavar="K")] = None
    """Do so for every marker, one in K at a time (K further fits)."""
    subject: str | None = None
    """Which person, where a capture holds several; otherwise each is fitted by itself."""
    rate: float | None = None
    """Frames a second, where the file does not say or says it wrong."""
    obj: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write an OBJ mesh a frame as well."""
    npz_style: Literal["habitus", "amass"] = "habitus"
    """What body.npz looks like: all that was found, or what AMASS scripts slice (docs/amass.md)."""
    seed: int = 0
    """Seed of what is drawn at random (the choice of frames)."""
    strict: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """End with exit code 3 where any fit has failed by its verdict."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""


OPTIONS, ABOUT = Mosh, Mosh.__doc__
FAILED_FIT = 3
COLOURS = {"good": "green", "doubtful": "yellow", "failed": "bold red"}


def run(options: Mosh, console: "Console | None" = None) -> int:
    """Do what the options say; gives the exit code, 3 where a fit failed under strict. HabitusError for bad input."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from habitus.jobs.mosh import mosh

    console = console or Console(quiet=options.quiet)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with told_of_compilation(options.quiet), Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("read", total=1.0)
        fits = mosh(
            options.captures,
            options.out,
            layout=options.layout,
            body=options.body,
            gender=options.gender,
            soft_tissue=not options.no_soft_tissue,
            causal=options.causal,
            hold_out=options.hold_out,
            hold_out_every=options.hold_out_every,
            subject=options.subject,
            rate_hz=options.rate,
            obj=options.obj,
            npz_style=options.npz_style,
            seed=options.seed,
            progress=lambda stage, share: bar.update(task, description=stage, completed=share),
        )
    for fit in fits:
        for warning in fit.warnings:
            console.print(f"[yellow]note[/] {fit.capture_name}: ", end="")
            console.print(warning, markup=False, highlight=False)
    for fit in fits:
        colour = COLOURS[fit.verdict.level]
        console.print(f"[{colour}]{fit.verdict.level}[/] {fit.capture_name}: ", end="")
        console.print(" ".join(fit.verdict.reasons), markup=False, highlight=False)
    console.print(summary(fits))
    console.print(f"results lie in {options.out}", markup=False, highlight=False)
    return FAILED_FIT if options.strict and any(fit.verdict.level == "failed" for fit in fits) else 0


def left(options: Mosh) -> str:
    """What a run that was stopped has left."""
    return "captures that were finished are whole"


def summary(fits: "list[MarkerFit]") -> "Table":
    """One row a capture."""
    from rich.table import Table

    table = Table(title="marker errors, mm")
    for heading in ("capture", "frames", "markers", "pose", "soft tissue", "held out", "suspects", "seconds"):
        table.add_column(heading, justify="left" if heading == "capture" else "right")
    for fit in fits:
        held = (
            None
            if fit.held_out is None
            else fit.held_out.pose
            if fit.held_out.soft_tissue is None
            else fit.held_out.soft_tissue
        )
        table.add_row(
            fit.capture_name,
            str(fit.num_frames),
            str(len(fit.labels)),
            *(_millimetres(errors) for errors in (fit.errors("pose"), fit.errors("soft_tissue"), held)),
            str(len(fit.suspects)),
            f"{sum(v for k, v in fit.stage_seconds.items() if v and k != 'total'):.1f}",
        )
    return table


def _millimetres(errors: "np.ndarray | None") -> str:
    import numpy as np

    if errors is None or not np.isfinite(errors).any():
        return "–"
    return f"{1e3 * np.nanmean(errors):.1f}"
