"""`habitus retarget`: another body, or a humanoid robot, in the same motion."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.errors import HabitusError, listed
from habitus.jobs.options import metavar, unset

if TYPE_CHECKING:
    from rich.console import Console

    from habitus.body.motion import BodyMotion


@dataclass(frozen=True)
class Retarget:
    """Transfer the motion of a fit to another body, with its soft tissue and foot contacts, or to a
    humanoid robot, within the limits of its joints.

    habitus retarget results/walk/body.npz --target character.obj --out character_walk.glb

    habitus retarget results/walk/body.npz --target female --out her_walk.npz

    habitus retarget results/walk/body.npz --target rigged.glb --out rigged_walk.glb

    habitus retarget walk.bvh --robot g1.xml --out walk_g1.npz

    See `docs/exaggerating-and-retargeting.md` and `docs/robots.md`.
    """

    source: Annotated[Path, tyro.conf.Positional, metavar("BODY.npz")]
    """A fit's body.npz, a motion that habitus wrote, an npz in AMASS's style, or the motion of any
    person's skeleton (bvh, glb, fbx).
    """
    out: Annotated[Path, metavar("FILE.npz|glb|csv|pkl|FOLDER")]
    """File for the motion; a folder receives an OBJ for each frame. A robot's is .npz, .csv or
    .pkl, and a page (.html) and numbers (.json) go beside it.
    """
    target: Annotated[str | None, unset("FILE|BETAS|NAME")] = None
    """A person (npz), a mesh of the body's topology (obj, ply), any rigged character (glb, gltf,
    vrm, fbx), betas (1.5,-0.5), or neutral, female, male.
    """
    robot: Annotated[Path | None, unset("FILE.xml|urdf")] = None
    """A humanoid robot, MJCF or URDF, in place of a target."""
    pairs: Annotated[str | None, unset("NAME|FILE.toml")] = None
    """Which of the robot's links is which segment of the body; found by the links' names where one
    of the shipped tables fits: booster_t1, fourier_n1, unitree_g1, unitree_h1.
    """
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second of the robot's motion; the source's where missing."""
    robot_style: Literal["habitus", "loco-mujoco", "isaac-lab"] = "habitus"
    """Form of a robot's npz."""
    body: Annotated[str | None, unset("FILE")] = None
    """The body model of the source, where it names no bundled one; of a skeleton's motion the body
    or the person (npz) that moves.
    """


SLIP = 0.003
"""Metres a second of feet that stand, above which a viewer sees them slip."""
OPTIONS = Retarget
ABOUT = Retarget.__doc__
NEEDS = ("habitus.jobs.motions", "habitus.jobs.robots", "habitus.jobs.characters")


def run(options: Retarget, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    console = console or screen()
    if options.robot is not None and options.target is None:
        _to_robot(options, console)
        return
    if options.target is None or options.robot is not None:
        raise HabitusError("expected one of --target and --robot: another body, or a robot")
    _check_unused(options)
    from habitus.jobs.characters import is_character
    from habitus.jobs.motions import motion_of, retarget

    source = motion_of(options.source, options.body)
    _say_reading(options, source, console)
    if is_character(options.target):
        _to_character(options, source, console)
        return
    retargeted = retarget(source, options.target, out=options.out)
    slip, below = ([1e3 * value for value in each] for each in (retargeted.slip, retargeted.below))
    say(console, f"legs are {retargeted.scale:.2f} times as long, and so is the way", "note")
    if retargeted.standing:
        say(
            console,
            f"feet stand for {retargeted.standing:.1f} s and move there by {slip[2]:.0f} mm/s "
            f"(source {slip[0]:.0f}, without keeping them {slip[1]:.0f})",
            "note",
        )
    say(console, f"lowest point {below[2]:.0f} mm from the ground (source {below[0]:.0f})", "note")
    say(
        console,
        f"{retargeted.motion.num_frames} frames of {plain(retargeted.motion.body_name)}, "
        f"{plain(options.out)}",
    )


def _say_reading(options: Retarget, motion: "BodyMotion", console: "Console") -> None:
    from habitus.jobs.exporting import reading_notes

    for note in reading_notes(options.source, motion):
        say(console, plain(note), "note")


def _check_unused(options: Retarget) -> None:
    """Refuse what only a robot takes."""
    given = {"--pairs": options.pairs, "--fps": options.fps}
    for name, value in given.items():
        if value is not None:
            raise HabitusError(f"{name} goes with --robot; leave it out with --target")


def _to_character(options: Retarget, source: "BodyMotion", console: "Console") -> None:
    from habitus.jobs.characters import retarget_to_character

    moved = retarget_to_character(source, str(options.target), out=options.out)
    match = moved.character.match
    say(console, f"joints by {plain(match.how)}; {plain(moved.character.notes[-1])}", "note")
    if match.unmatched:
        say(console, f"not matched, kept still: {plain(listed(match.unmatched, 12))}", "note")
    say(console, f"the way is scaled by {moved.scale:.2f}, as the character's legs are", "note")
    say(
        console,
        f"feet stand for {moved.standing:.1f} s and slip by {1e3 * moved.slip[0]:.1f} mm/s (at "
        f"most {1e3 * moved.slip[1]:.0f}); lowest point {1e3 * moved.below[1]:.0f} mm from the "
        f"ground (source {1e3 * moved.below[0]:.0f})",
        "note",
    )
    if moved.slip[0] > SLIP:
        say(console, "feet slip: legs do not reach where the source's stand", mark="doubtful")
    say(console, f"{moved.motion.num_frames} frames, {plain(options.out)}")


def _to_robot(options: Retarget, console: "Console") -> None:
    from habitus.jobs.robots import retarget_to_robot

    assert options.robot is not None
    made = retarget_to_robot(
        options.source,
        options.robot,
        pairs=options.pairs,
        body=options.body,
        fps=options.fps,
        out=options.out,
        style=options.robot_style,
    )
    _say_reading(options, made.source, console)
    quality = made.quality
    say(console, f"places are scaled by {made.result.scale:.2f}, as the robot's legs are", "note")
    say(
        console,
        f"segments {quality.mean_direction:.1f} degrees off on average, standing feet slip by "
        f"{1e3 * quality.slip:.1f} mm/s, {1e3 * quality.penetration:.1f} mm below the ground at "
        "most",
        "note",
    )
    if quality.verdict.level != "good":
        reasons = " ".join(quality.verdict.reasons)
        say(console, reasons, mark=quality.verdict.level)
    say(
        console,
        f"{made.motion.num_frames} frames of {plain(made.motion.robot.name)}, "
        f"{plain(options.out)} and {plain(options.out.with_suffix('.html'))}",
    )


def left(options: Retarget) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
