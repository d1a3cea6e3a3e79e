"""A body in motion as a file, by its ending: for animation, for gait labs, for scripts."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from habitus.arrays import first_not_finite
from habitus.body.motion import BodyMotion, Moving
from habitus.body.recentred import recentred_arrays
from habitus.body.skin import skin_mesh, skin_of, skin_tone
from habitus.body.state import BodySurface
from habitus.body.surface_files import write_surface
from habitus.errors import HabitusError, shown
from habitus.export.animation import Animation, body_at
from habitus.export.bvh import write_bvh
from habitus.export.correctives import check_correctives
from habitus.export.driven import write_drivers
from habitus.export.fbx.write import write_fbx
from habitus.export.glb import write_glb
from habitus.export.mot import write_mot
from habitus.export.npz import check_npz_style, motion_arrays, write_amass, write_arrays, write_npz
from habitus.export.obj import write_obj_sequence
from habitus.export.rates import at_rate
from habitus.export.rigging import Bones
from habitus.export.skeleton import check_axes
from habitus.export.skins import write_painted_surface
from habitus.export.trc import write_points
from habitus.export.usd import ENDINGS, write_usd
from habitus.export.vrm import write_vrm
from habitus.fit.markers.result import MarkerFit
from habitus.fit.verdict import Verdict
from habitus.parallel.blocks import drop_pages
from habitus.rotations import up_rotation


@dataclass(frozen=True)
class WriteOptions:
    """What a file shall show of a motion: its blend shapes, its level of detail, of a still one
    which frame, of an npz which style, its skin, and its bones.
    """

    correctives: str = "auto"
    detail: str = "full"
    frame: int | None = None
    npz_style: str = "habitus"
    face: bool = False
    skin: str | float | None = None
    bones: Bones = field(default_factory=Bones)


@dataclass(frozen=True)
class Exported:
    """What was written: frames, their rate, how many blend shapes, and how far they leave a vertex
    (m) at the worst.

    ``drivers``: the file beside it that says how bones drive them (`habitus.export.driven`), where
    they do; ``elsewhere`` (m): how far they leave a vertex at the worst in poses that people take.
    ``skinned``: whether the mesh has a skin. ``error_mm`` and ``verdict``: of the parameters of a
    user's own model, how far its vertices are from our surface ("mean", "p95").
    """

    path: Path
    frames: int
    rate_hz: float
    morphs: int = 0
    worst: float = 0.0
    drivers: Path | None = None
    elsewhere: float = 0.0
    skinned: bool = False
    error_mm: Mapping[str, float] | None = None
    verdict: Verdict | None = None


def write_motion(motion: BodyMotion, path: str | os.PathLike[str]) -> None:
    """Write a `BodyMotion` as .npz, atomically; `habitus.io.people.load_motion` reads it back.

    The names of AMASS and of a fit's body.npz (`habitus.export.npz.write_npz`), without markers;
    ``made`` says in sentences where the motion comes from. A character's file holds its surface,
    ``character_vertices`` (V, 3; m, at rest), and the name of the body that it was made of,
    ``character_base``. Raises HabitusError where it cannot be written.
    """
    arrays = motion_arrays(motion) | dict(recentred_arrays(motion.body))
    arrays["made"] = np.array(motion.made, dtype=np.str_)
    write_arrays(path, arrays)


def _npz(moving: Moving, path: Path, options: WriteOptions) -> None:
    if options.npz_style == "amass":
        write_amass(moving, path)
        return
    write_npz(moving, path) if isinstance(moving, MarkerFit) else write_motion(
        BodyMotion.of(moving), path
    )


def _still(moving: Moving, path: Path, options: WriteOptions) -> None:
    """One surface, +y up: of a frame, or the person at rest."""
    body = body_at(moving, options.detail)
    if options.frame is None:
        _write_surface(body(moving.betas), path, options.skin)
        return
    if not 0 <= options.frame < len(moving.pose):
        raise HabitusError(f"frame is {options.frame}; expected 0 to {len(moving.pose) - 1}")
    surface = next(moving.surfaces([options.frame], body=body))
    turned = surface.vertices[0] @ up_rotation(moving.up_axis).T
    _write_surface(replace(surface, vertices=turned, joints=surface.joints[0]), path, options.skin)


def _write_surface(surface: BodySurface, path: Path, skin: str | float | None) -> None:
    texture = skin_of(surface.mesh, skin)
    if texture is None:
        write_surface(surface, path)
    else:
        write_painted_surface(surface, path, texture)


def _meshed(writer: Callable[..., Animation]) -> "_Writer":
    return lambda moving, path, wanted: writer(
        moving,
        path,
        correctives=wanted.correctives,
        detail=wanted.detail,
        face=wanted.face,
        skin=wanted.skin,
        bones=wanted.bones,
    )


_Writer = Callable[[Moving, Path, WriteOptions], object]
_WRITERS: Mapping[str, tuple[_Writer, str]] = {
    ".npz": (_npz, "AMASS's names"),
    ".glb": (_meshed(write_glb), "animated mesh"),
    ".fbx": (_meshed(write_fbx), "animated mesh"),
    **{ending: (_meshed(write_usd), "animated mesh") for ending in ENDINGS},
    ".vrm": (
        lambda moving, path, wanted: write_vrm(
            moving, path, detail=wanted.detail, skin=wanted.skin, bones=wanted.bones
        ),
        "an avatar without motion",
    ),
    ".bvh": (
        lambda moving, path, wanted: write_bvh(moving, path, wanted.bones.table),
        "skeleton",
    ),
    ".trc": (lambda moving, path, wanted: write_points(moving, path), "joints and markers"),
    ".mot": (lambda moving, path, wanted: write_mot(moving, path), "OpenSim's joint angles"),
    ".obj": (_still, "one mesh"),
    ".ply": (_still, "one mesh"),
    "": (
        lambda moving, path, wanted: write_obj_sequence(moving, path, skin=wanted.skin),
        "a folder with an OBJ mesh a frame",
    ),
}


RIGGED = (".glb", ".fbx", *ENDINGS, ".vrm")
"""Files with bones that have axes."""
LIGHT = 40
"""Blend shapes of correctives and soft tissue that a light file has, at most."""
MESHES = (".glb", ".fbx", *ENDINGS, ".vrm", ".obj", ".ply", "")
SKINNED = ", ".join(MESHES[:-1]) + ", a folder of OBJ"


def export_motion(
    motion: Moving,
    path: str | os.PathLike[str],
    *,
    fps: float | None = None,
    correctives: str = "auto",
    detail: str = "full",
    frame: int | None = None,
    npz_style: str = "habitus",
    face: bool = False,
    skin: str | float | None = None,
    rig: str | None = None,
    bones: str = "along",
    root_bone: bool = False,
    light: bool = False,
) -> Exported:
    """Write a fit or a motion as one file, by its ending, and say what was written.

    .fbx, .glb, .usd, .usdc, .usda, .usdz: the skinned mesh in motion; .bvh: its skeleton; .trc:
    joints and, of a fit, markers; .mot: OpenSim's joint angles; .npz: AMASS's names; .obj, .ply:
    one mesh, of a ``frame`` or at rest; without an ending: a folder with an OBJ mesh a frame. All
    but .npz and the folder have +y up.

    fps: another rate than the motion's (`habitus.export.rates.at_rate`); a fit loses its markers by
    it. correctives: which blend shapes a mesh is given, "auto", "all", "none", "live:96" or
    "pca:16" (`habitus.export.correctives.morphs_of`); with "all" and "live" a file that says how
    bones drive them lies beside it (`habitus.export.driven`). detail: "full", "parts", that with
    teeth, tongue and lashes, or "coarse", the mesh that was fitted. npz_style: "habitus", or
    "amass", the columns of AMASS's scripts (`habitus.export.npz.write_amass`), for .npz only. face:
    a mesh has a blend shape for each of the face's units, with ARKit's names
    (`habitus.export.faces`). skin: of a mesh of the default bodies a tone, "light", "medium",
    "dark" or a number from 0 (light) to 1 (dark); by itself, "none", it is plain
    (`habitus.body.skin`). rig: "mixamo", "manny", "humanoid", "vrm" or "rokoko", for bones by the
    names, the hierarchy and the rest pose of these; bones: "along", with +y along each limb, or
    "world", turned like the world at rest; root_bone: the pelvis hangs on a bone on the floor
    (`habitus.export.rigging`). light: at most `LIGHT` blend shapes, beside the face's, those of the
    largest effect in this motion. .vrm: the person at rest, without motion. Raises HabitusError for
    other endings and options, for a missing extra, and where the file cannot be written.
    """
    target = Path(path)
    check_motion_path(target)
    check_correctives(correctives)
    check_npz_style(npz_style, motion.body)
    if npz_style != "habitus" and target.suffix.lower() != ".npz":
        raise HabitusError(f"{target.name}: npz_style is for a name that ends in .npz")
    tone = skin_tone(skin)
    if tone is not None and target.suffix.lower() not in MESHES:
        raise HabitusError(f"{target.name}: skin is for files that hold a mesh ({SKINNED})")
    made = _bones(target, rig, bones, root_bone)
    if light:
        correctives = _light(target, correctives)
    _check_finite(motion)
    moving = at_rate(motion, fps)
    written = _WRITERS[target.suffix.lower()][0](
        moving, target, WriteOptions(correctives, detail, frame, npz_style, face, tone, made)
    )
    frames = 1 if _WRITERS[target.suffix.lower()][0] is _still else len(moving.pose)
    mesh = skin_mesh(body_at(moving, detail).mesh) if tone is not None else None
    exported = Exported(target, frames, float(moving.rate_hz), skinned=mesh is not None)
    if not isinstance(written, Animation):
        return exported
    return replace(
        exported,
        frames=len(written.tracks[0].quaternions),
        rate_hz=written.rate_hz,
        morphs=len(written.morphs),
        worst=written.morph_worst,
        drivers=write_drivers(written, target),
        elsewhere=written.morph_elsewhere,
    )


def _bones(target: Path, rig: str | None, axes: str, root_bone: bool) -> Bones:
    """Raises HabitusError for bones that the file cannot have."""
    ending = target.suffix.lower()
    if ending == ".vrm" and rig not in (None, "vrm"):
        raise HabitusError(f"{target.name}: rig is {shown(rig)}; a .vrm has the bones of vrm")
    made = Bones("vrm" if ending == ".vrm" else rig, axes, root_bone)
    if ending in RIGGED or made == Bones():
        check_axes(axes)
        return replace(made, rig=made.table.name if made.table else None)
    if ending == ".bvh" and made == Bones(rig):
        return made if made.table else Bones()
    raise HabitusError(
        f"{target.name}: rig, bones and root_bone are for {', '.join(RIGGED)}, and rig for .bvh"
    )


def _light(target: Path, correctives: str) -> str:
    """The blend shapes of a light file: as many directions as make `LIGHT`, forth and back."""
    if target.suffix.lower() not in (".glb", ".fbx", *ENDINGS):
        raise HabitusError(f"{target.name}: light is for .glb, .fbx and USD")
    if correctives not in ("auto", "none"):
        raise HabitusError(
            f"light chooses the blend shapes itself; leave out correctives ({shown(correctives)})"
        )
    return correctives if correctives == "none" else f"pca:{LIGHT // 2}"


def _check_finite(motion: Moving) -> None:
    """Raises HabitusError, naming the first frame, where a pose or a place is no number."""
    arrays = {"pose": motion.pose, "trans": motion.trans, "betas": motion.betas}
    arrays |= {"soft_tissue": motion.soft_tissue, "dynamics": motion.dynamics, "face": motion.face}
    for name, array in arrays.items():
        at = None if array is None else first_not_finite(np.asarray(array))
        drop_pages(array)
        if at is not None:
            raise HabitusError(
                f"{motion.capture_name}: {name} at {'coefficient' if name == 'betas' else 'frame'} "
                f"{at}, counted from 0, are no finite numbers; leave these frames out or fit again"
            )


def check_motion_path(path: str | os.PathLike[str]) -> None:
    """Raises HabitusError for an ending that no motion is written to."""
    target = Path(path)
    if target.suffix.lower() not in _WRITERS:
        listed = ", ".join(f"{ending} ({what})" for ending, (_, what) in _WRITERS.items() if ending)
        raise HabitusError(
            f"cannot write a motion to {target.name}: expected {listed}, or a name without an "
            "ending "
            f"({_WRITERS[''][1]})"
        )
