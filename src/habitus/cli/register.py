"""`habitus register`: from scans to surfaces in the body's topology."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import FAILED_FIT, Strict, compilation_notice, progress_bar, say, screen
from habitus.errors import HabitusError, shown
from habitus.jobs.options import RegisterOptions, metavar, unset

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.fit.points.scan_result import ScanFit


@dataclass(frozen=True, kw_only=True)
class _Files:
    scans: Annotated[tuple[Path, ...], tyro.conf.Positional, unset("SCAN|FOLDER [SCAN|FOLDER …]")]
    """PLY, OBJ, STL, glb, OFF or XYZ files of one person, or folders of such; with --coregister a
    folder for each person.
    """
    out: Annotated[Path, metavar("FOLDER")]
    """Folder for the results."""
    body: Annotated[str, metavar("NAME|FILE")] = "default"
    """Body whose topology the surfaces get: female, male, neutral, a file, or default: of these
    three the one with the lowest error.
    """
    topology: Annotated[Literal["smpl", "smplx", "mhr"] | None, unset("smpl|smplx|mhr")] = None
    """SCAN is one mesh, or an npz with vertices (T, V, 3), in this topology's order, which says
    where each vertex lies: no scan is matched, OUT gets body.npz (docs/other-bodies.md).
    """
    own_surface: bool = False
    """With a topology: the body's mean person becomes this one; betas are zero then."""
    fps: Annotated[float | None, unset("HZ")] = None
    """With a topology: frames a second, where the file names none."""


@dataclass(frozen=True, kw_only=True)
class Register(Strict, RegisterOptions, _Files):
    """Register scans of a person to a body: shape, pose, and a free surface that follows the scan.

    habitus register front.ply back.ply --out results/anna

    Meshes or point clouds, of any unit and orientation, with holes, noise, a floor. Of each scan
    OUT/<name>/ receives body.npz, surface.ply, surface.glb, model.ply, rest.ply (which `habitus
    measure` reads), metrics.json and report.html; OUT/registrations.npz is what `habitus train`
    reads. `docs/registering-scans.md` explains how to scan.

    habitus register anna_in_a_jacket.ply --clothes loose --out results/anna

    habitus register her_smplx.npz --topology smplx --out results/her
    """


OPTIONS = Register
ABOUT = Register.__doc__
NEEDS = ("habitus.jobs.register", "habitus.jobs.topologies", "rich.progress", "numba.core.event")


def run(options: Register, console: "Console | None" = None) -> int:
    """Do what the options say; 3 under ``strict`` where a fit failed by its verdict. Raises
    HabitusError.
    """
    console = console or screen(options.quiet)
    if options.topology is not None:
        return _from_topology(options, console)
    if options.own_surface or options.fps is not None:
        raise HabitusError("--own-surface and --fps go with --topology; leave them out")
    from habitus.jobs.register import register_scans

    with compilation_notice(options.quiet), progress_bar(console) as bar:
        task = bar.add_task("read", total=1.0)
        fits = register_scans(
            options.scans,
            options.body,
            options=options,
            out=options.out,
            progress=lambda stage, share: bar.update(
                task, description=shown(stage), completed=share
            ),
        )
    for fit in fits:
        _print_fit(fit, console)
    say(console, f"wrote {options.out}")
    return (
        FAILED_FIT if options.strict and any(fit.verdict.level == "failed" for fit in fits) else 0
    )


def _from_topology(options: Register, console: "Console") -> int:
    from habitus.jobs.topologies import register_vertices

    assert options.topology is not None
    if len(options.scans) != 1:
        raise HabitusError(f"{len(options.scans)} files; expected one with --topology")
    unused = (options.age, options.sex, options.separate, options.sequence, options.texture)
    if any(unused) or options.coregister or options.clothes != "none":
        raise HabitusError(
            "--age, --sex, --separate, --sequence, --texture, --coregister, --clothes go without "
            "--topology"
        )
    with compilation_notice(options.quiet), progress_bar(console) as bar:
        task = bar.add_task("read", total=1.0)
        made = register_vertices(
            options.scans[0],
            options.topology,
            options.body,
            out=options.out,
            unit=options.unit,
            up=options.up,
            fps=options.fps,
            own_surface=options.own_surface,
            progress=lambda stage, share: bar.update(
                task, description=shown(stage), completed=share
            ),
        )
    say(
        console,
        f"{made.motion.num_frames} frames of {options.topology} on {made.motion.body_name}: "
        f"{made.verdict.level}; {made.error_mm['mean']:.1f} mm off on average, 95 % "
        f"{made.error_mm['p95']:.1f} mm",
    )
    for reason in made.verdict.reasons:
        say(console, reason, made.verdict.level)
    say(console, f"wrote {options.out}")
    return FAILED_FIT if options.strict and made.verdict.level == "failed" else 0


def _print_fit(fit: "ScanFit", console: "Console") -> None:
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
    """What a stopped run leaves."""
    return "finished scans are complete"
