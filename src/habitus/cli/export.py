"""`habitus export`: a fit as a file for Blender, Maya, Unity, Unreal, OpenSim."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from habitus.cli.screen import plain, say, screen
from habitus.jobs.options import metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Export:
    """Write a fit, or another motion, as a file for other programs; the ending selects the format.

    habitus export results/walk/body.npz --out walk.fbx

    habitus export results/walk/body.npz --out walk.glb --fps 30 --bake-correctives pca:16

    habitus export him.npz --out him.fbx --bake-correctives all      (him.npz: of habitus body)

    habitus export results/walk/body.npz --topology smplx --out walk_smplx.npz

    habitus export results/walk/body.npz --model SMPLX_NEUTRAL.npz --out walk_amass.npz

    habitus export him.npz --out him.vrm --skin medium

    .fbx, .glb, .usd, .usdc, .usda, .usdz: the skinned body in motion; .vrm: an avatar at rest;
    .bvh: the skeleton in motion; .trc: joints and markers; .mot: OpenSim's joint angles; .obj,
    .ply: one mesh; .npz: the fit or motion. `docs/exporting.md` explains how programs import them.
    """

    source: Annotated[Path, tyro.conf.Positional, metavar("BODY.npz")]
    """A fit's body.npz or its folder, a motion that habitus wrote, an npz in AMASS's style, or the
    motion of any person's skeleton (bvh, glb, fbx); for a rig at rest a person's npz, or neutral,
    female, male.
    """
    out: Annotated[Path, metavar("FILE")]
    """Output file; the ending selects the format."""
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second, where other than the capture's."""
    bake_correctives: Annotated[str, metavar("auto|all|live:96|pca:16|none")] = "auto"
    """Blend shapes: the fewest that keep every vertex within 0.1 mm, all of the body's own, a
    number (live: that bones can drive), or none.
    """
    detail: Literal["full", "parts", "coarse"] = "full"
    """The mesh: the body's full level, that with teeth, tongue and lashes, or the one fitted."""
    frame: Annotated[int | None, unset("K")] = None
    """Of .obj and .ply: this frame, from 0 on, instead of the person at rest."""
    npz_style: Literal["habitus", "amass"] = "habitus"
    """Of .npz: all results, or the columns that AMASS scripts read (docs/amass.md)."""
    face: bool = False
    """Of meshes: a blend shape for each face unit, with ARKit's names."""
    skin: Annotated[str, metavar("none|light|medium|dark|0..1")] = "none"
    """Skin of a default body's mesh: a tone from 0 (light) to 1 (dark); none: a plain material."""
    rig: Annotated[str, metavar("none|mixamo|manny|humanoid|vrm|rokoko")] = "none"
    """Bones by the names, hierarchy and rest pose of Mixamo, Unreal's Manny, Unity's humanoids, VRM
    1.0 or Rokoko.
    """
    bones: Literal["along", "world"] = "along"
    """Axes of bones: +y along the limb, or turned like the world at rest."""
    root_bone: bool = False
    """A bone on the floor, which the pelvis hangs on, for root motion."""
    light: bool = False
    """At most 40 blend shapes, beside the face's, for game engines."""
    topology: Annotated[Literal["smpl", "smplx", "mhr"] | None, unset("smpl|smplx|mhr")] = None
    """Vertices in this topology instead, without its model: .npz (all frames), .obj, .ply, or a
    folder (docs/other-bodies.md).
    """
    model: Annotated[Path | None, unset("FILE")] = None
    """Your SMPL, SMPL-H or SMPL-X (npz, pkl): its betas and pose are solved for, into an .npz."""
    body: Annotated[str | None, unset("FILE")] = None
    """The body model of the source, where it names no bundled one; of a skeleton's motion the body
    or the person (npz) that moves.
    """


OPTIONS = Export
ABOUT = Export.__doc__
NEEDS = ("habitus.jobs.exporting",)


def run(options: Export, console: "Console | None" = None) -> None:
    """Do what the options say. Raises HabitusError for bad input."""
    from habitus.jobs.exporting import export_file, read_moving, reading_notes

    console = console or screen()
    fingers = options.rig != "none" or options.out.suffix.lower() == ".vrm"
    moving = read_moving(options.source, options.body, with_fingers=fingers)
    for note in reading_notes(options.source, moving):
        say(console, plain(note), "note")
    exported = export_file(
        moving,
        options.out,
        fps=options.fps,
        correctives=options.bake_correctives,
        detail=options.detail,
        frame=options.frame,
        npz_style=options.npz_style,
        face=options.face,
        skin=None if options.skin == "none" else options.skin,
        rig=None if options.rig == "none" else options.rig,
        bones=options.bones,
        root_bone=options.root_bone,
        light=options.light,
        topology=options.topology,
        model=options.model,
    )
    if exported.error_mm is not None:
        mean, p95 = exported.error_mm["mean"], exported.error_mm["p95"]
        say(
            console,
            f"the model's vertices are {mean:.1f} mm off the surface on average, 95 % {p95:.1f} mm",
            "note",
        )
    if exported.verdict is not None and exported.verdict.level != "good":
        say(console, plain(" ".join(exported.verdict.reasons)), exported.verdict.level)
    if exported.morphs or exported.worst:
        worst = f"{1e3 * exported.worst:.2g} mm" if exported.worst else "less than 0.01 mm"
        other = (
            f", up to {1e3 * exported.elsewhere:.2g} mm in other poses"
            if exported.elsewhere
            else ""
        )
        say(
            console,
            f"{exported.morphs} blend shapes; what they leave out: {worst} at the worst vertex"
            f"{other}",
            "note",
        )
    if exported.drivers is not None:
        say(
            console,
            "how bones drive them in any pose (for Unity, Maya, Unreal): "
            f"{plain(exported.drivers)}",
            "note",
        )
    if options.skin != "none" and not exported.skinned:
        say(console, "plain material: skin is for the full mesh of the default bodies", "note")
    size = f", {exported.path.stat().st_size / 1e6:.1f} MB" if exported.path.is_file() else ""
    what = (
        "one mesh"
        if exported.frames == 1
        else f"{exported.frames} frames at {exported.rate_hz:g} Hz"
    )
    say(console, f"{what}{size}: {plain(exported.path)}")


def left(options: Export) -> str:
    """What a stopped run leaves."""
    return "nothing was written"
