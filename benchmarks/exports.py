"""What other programs see of a fit: every format read back and held against the fit's own surface;
size and time.

    python benchmarks/exports.py --body results/85_12/body.npz [--out DIR] [--frames 12]
    python benchmarks/exports.py --light [--body results/85_12/body.npz] [--frames 60]

Read by the tests' own readers of FBX, glTF and BVH, by UsdSkel, and by Blender where it is here
(the program, or the module bpy). Prints a table, writes exports.json.

--light: what fewer blend shapes cost a .glb, read by the tests' reader: all that the motion needs,
``--light``, and none. Without --body on a made motion of the default body: 600 frames at 60 Hz, the
joints turning by up to 85 degrees in smooth waves about three axes at paces of their own.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
from common import ROOT, in_words, machine, parser

sys.path.insert(0, str(ROOT / "tests" / "helpers"))

from read_blender import PROGRAMS, READERS, in_blender
from read_bvh import Bvh
from read_fbx import Fbx
from read_glb import Glb

import habitus
from habitus.body.motion import BodyMotion
from habitus.export.motion import export_motion
from habitus.export.seams import seams_of
from habitus.rotations import up_rotation


def main() -> None:
    """Export, read back, compare."""
    arguments = parser(__doc__)
    arguments.add_argument("--body", help="a fit's body.npz")
    arguments.add_argument("--light", action="store_true", help="compare numbers of blend shapes")
    arguments.add_argument("--out", type=Path, default=Path("out/exports"))
    arguments.add_argument("--frames", type=int, default=12, help="how many are read back")
    options = arguments.parse_args()
    here = machine()
    if options.light:
        light(options.body, options.out, options.frames, here)
        return
    if options.body is None:
        raise SystemExit("expected --body, a fit's body.npz, or --light")
    fit = habitus.load_fit(options.body)
    frames = np.linspace(0, fit.num_frames - 1, options.frames).astype(int)
    known = np.concatenate([part.vertices for part in fit.surfaces(frames, body=fit.finest_body)])
    rows = []
    for ending in ("fbx", "glb", "usdc", "usdz", "bvh", "trc", "mot"):
        began = time.perf_counter()
        told = export_motion(fit, options.out / f"a.{ending}")
        row = {"format": ending, "seconds": time.perf_counter() - began, "morphs": told.morphs}
        row |= {"megabytes": told.path.stat().st_size / 1e6, "left_out_mm": 1e3 * told.worst}
        rows.append(row | {"off_mm": _read_back(fit, told.path, frames, known)})
        print(_line(rows[-1]), flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    found = {"machine": here, "capture": fit.capture_name, "frames": fit.num_frames, "rows": rows}
    (options.out / "exports.json").write_text(json.dumps(found, indent=1))
    print(f"{fit.capture_name}, {fit.num_frames} frames; {in_words(here)}")


LIGHT = {"auto": {}, "--light": {"light": True}, "none": {"correctives": "none"}}
MADE_FRAMES, MADE_HZ, TURN = 600, 60.0, np.deg2rad(85.0)


def made_motion() -> BodyMotion:
    """The default body in smooth waves about all three axes of every joint."""
    rng = np.random.default_rng(0)
    body = habitus.load_body("default")
    count = body.num_joints
    pace, phase = rng.uniform(0.2, 1.0, (count, 3)), rng.uniform(0.0, 2.0 * np.pi, (count, 3))
    time_s = np.arange(MADE_FRAMES)[:, None, None] / MADE_HZ
    turns = np.sin(2.0 * np.pi * pace * time_s + phase)
    turns /= np.linalg.norm(turns, axis=-1).max(axis=0)[:, None]
    turns *= TURN * rng.uniform(0.2, 1.0, (count, 1))
    trans = np.zeros((MADE_FRAMES, 3))
    return BodyMotion(body, np.zeros(body.num_betas), turns, trans, MADE_HZ, "+y")


def light(source: str | None, out: Path, count: int, here: dict) -> None:
    """Size and error of a .glb by its blend shapes."""
    motion = made_motion() if source is None else BodyMotion.of(habitus.load_fit(source))
    frames = np.unique(np.linspace(0, motion.num_frames - 1, count).astype(int))
    turn = up_rotation(motion.up_axis)
    seams = seams_of(motion.finest_body).source
    surfaces = motion.surfaces(frames, body=motion.finest_body)
    known = np.concatenate([part.vertices for part in surfaces]) @ turn.T
    rows = []
    for name, given in LIGHT.items():
        written = export_motion(motion, out / "light.glb", **given)
        read = Glb(written.path)
        off = [
            np.linalg.norm(read.vertices(frame / motion.rate_hz) - one[seams], axis=-1)
            for frame, one in zip(frames, known, strict=True)
        ]
        row = {"blend shapes": written.morphs, "megabytes": written.path.stat().st_size / 1e6}
        rms = float(np.sqrt(np.mean(np.square(off))))
        row |= {"worst_mm": 1e3 * float(np.max(off)), "rms_mm": 1e3 * rms}
        rows.append({"name": name} | row)
        print(name, ", ".join(f"{key} {value:.4g}" for key, value in row.items()), flush=True)
    found = {"machine": here, "frames": motion.num_frames, "read": len(frames), "rows": rows}
    (out / "light.json").write_text(json.dumps(found, indent=1))
    print(f"{motion.num_frames} frames, {len(frames)} of them read; {in_words(here)}")


def _line(row: dict) -> str:
    off = ", ".join(f"{reader} {value:.3f} mm" for reader, value in row["off_mm"].items())
    return (
        f"{row['format']:5} {row['megabytes']:6.1f} MB {row['seconds']:6.1f} s "
        f"{row['morphs']:4} morphs  {off}"
    )


def _read_back(
    fit: habitus.Mosh, path: Path, frames: np.ndarray, known: np.ndarray
) -> dict[str, float]:
    """How far the worst vertex (of .bvh: joint) of these frames is from the fit, in mm, by
    reader.
    """
    turn = up_rotation(fit.up_axis)
    kind = path.suffix[1:]
    upright = known @ turn.T
    found = {}
    if kind == "fbx":
        read = Fbx(path)
        found["own reader"] = _worst(
            read.vertices(frame) - known for frame, known in zip(frames, upright, strict=True)
        )
    if kind == "glb":
        read = Glb(path)
        source = seams_of(fit.finest_body).source
        times = frames / fit.rate_hz
        found["own reader"] = _worst(
            read.vertices(at) - one[source] for at, one in zip(times, upright, strict=True)
        )
    if kind == "bvh":
        read = Bvh(path)
        joints = fit.joints(list(frames)) @ turn.T
        placed = (
            np.array([read.joints(frame)[name] for name in fit.body.joint_names]) / 100
            for frame in frames
        )
        found["own reader"] = _worst(one - known for one, known in zip(placed, joints, strict=True))
    if kind in ("usdc", "usdz"):
        from pxr import Usd
        from read_usd import skinned

        stage = Usd.Stage.Open(str(path))
        found["UsdSkel"] = _worst(
            skinned(stage, int(f)) - one for f, one in zip(frames, upright, strict=True)
        )
    for program, readers in READERS.items():
        chosen = {
            reader: operator for reader, (ending, operator) in readers.items() if ending == kind
        }
        if PROGRAMS[program] is None or not chosen:
            continue
        seen = in_blender(
            program, [(path, operator) for operator in chosen.values()], round(fit.rate_hz), frames
        )
        source = seams_of(fit.finest_body).source if kind == "glb" else slice(None)
        for reader, surfaces in zip(chosen, seen, strict=True):
            away = (surfaces[frame] - one[source] for frame, one in zip(frames, known, strict=True))
            found[f"{program}, {reader}"] = _worst(away)
    return found


def _worst(differences) -> float:
    return 1e3 * max(float(np.linalg.norm(each, axis=-1).max()) for each in differences)


if __name__ == "__main__":
    main()
