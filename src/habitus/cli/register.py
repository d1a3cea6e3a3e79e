"""`habitus register`: from scans to surfaces in the body's topology."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.first_run import told_of_compilation
from habitus.cli.screen import Flag, progress_bar, say, screen, unset
from habitus.errors import shown

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.fit.points.scan_result import ScanFit


@dataclass(frozen=True)
class Register:
    """Register scans of a person to a body: shape, pose, and a free surface that follows the scan.

    habitus register front.ply back.ply --out results/anna

    Meshes or clouds of points, of any unit and orientation, with holes, noise, a floor. Of each
    scan OUT/<name>/ receives body.npz, surface.ply, surface.glb, model.ply, rest.ply (which
    `habitus measure` reads), metrics.json and report.html; OUT/registrations.npz is what `habitus
    train` reads. `docs/registering-scans.md` tells how to scan.
    """

    scans: Annotated[tuple[Path, ...], tyro.conf.Positional, unset("SCAN|FOLDER [SCAN|FOLDER …]")]
    """PLY, OBJ, STL, glb, OFF or XYZ files of one person, or folders of such."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results."""
    body: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "default"
    """Whose topology surfaces get: female, male, neutral, a file, or default: of these the one that
    fits best.
    """
    age: Annotated[float | None, unset("YEARS")] = None
    """How old the person is, 5 to 80; a grown person without it."""
    sex: Annotated[Literal["female", "male"] | None, unset("female|male")] = None
    """What registrations.npz tells `habitus train` of the person; the fit does not use it."""
    unit: Literal["auto", "m", "cm", "mm", "in", "ft"] = "auto"
    """The unit of the scans' numbers; "auto" takes m, cm or mm by the size of a person."""
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = "auto"
    """The scans' axis that points up; "auto" finds it."""
    separate: Flag = False
    """Every scan is another person."""
    sequence: Flag = False
    """The scans are in time order: each begins where the one before ended."""
    texture: Flag = False
    """Colours of two scans or more of the person make their correspondences sharper."""
    strict: Flag = False
    """End with exit code 3 where a registration has failed by its verdict."""
    quiet: Flag = False
    """Print nothing but errors."""


OPTIONS = Register
ABOUT = Register.__doc__
NEEDS = ("habitus.jobs.register", "rich.progress", "numba.core.event")


def run(options: Register, console: "Console | None" = None) -> int:
    """Do what the options say; 3 under ``strict`` where a fit failed by its verdict. Raises
    HabitusError.
    """
    from habitus.errors import HabitusError
    from habitus.jobs.register import register_scans

    if options.separate and options.sequence:
        raise HabitusError(
            "--separate and --sequence were given; expected one: a sequence is of one person"
        )
    console = console or screen(options.quiet)
    with told_of_compilation(options.quiet), progress_bar(console) as bar:
        task = bar.add_task("read", total=1.0)
        fits = register_scans(
            options.scans,
            options.body,
            out=options.out,
            unit=options.unit,
            up=options.up,
            separate=options.separate,
            sequence=options.sequence,
            age=options.age,
            sex=options.sex or "",
            texture=options.texture,
            progress=lambda stage, share: bar.update(
                task, description=shown(stage), completed=share
            ),
        )
    for fit in fits:
        _tell(fit, console)
    say(console, f"wrote {options.out}")
    return 3 if options.strict and any(fit.verdict.level == "failed" for fit in fits) else 0


def _tell(fit: "ScanFit", console: "Console") -> None:
    import numpy as np

    median, p95 = np.percentile(1e3 * fit.to_surface, (50, 95))
    height = fit.measurements.get("height_m")
    tall = "" if height is None else f", {height:.2f} m tall"
    say(
        console,
        f"{fit.scan_name}: {fit.verdict.level}; scan to surface {median:.2f} mm (median), "
        f"{p95:.1f} mm (95 %), "
        f"{100 * fit.seen:.0f} % of the body seen{tall}",
    )
    for reason in fit.verdict.reasons:
        say(console, reason, fit.verdict.level)
    if fit.colours is not None:
        say(
            console,
            f"colours differ from other scans' by {fit.colours.before:.3f} before and "
            f"{fit.colours.after:.3f} after "
            f"the surface slid by {1e3 * fit.colours.slid:.2f} mm (log of linear light)",
        )
    for note in fit.notes:
        say(console, note, "note")


def left(options: Register) -> str:
    """What a run that was stopped has left."""
    return "scans that were finished are whole"
