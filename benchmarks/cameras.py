"""How near do bodies from keypoints of calibrated cameras come to the truth?

    python benchmarks/cameras.py CAPTURE ... [--seeds 3] [--frames 120] [--out FILE]

Each capture is fitted once by `habitus.mosh`; its motion, 120 frames at 50 Hz or more, is then of
other people, drawn from women's and men's bodies with all their betas, which the fit, of the
neutral body with ten, cannot reach. They stand before rings of cameras whose detections are made by
`habitus_lab.population.camera_scenes`. Errors (mm) are distances of joints (fingers apart) and
vertices from where they are, without any alignment. ``spoilt``: copies of the scenes that have one
fault; the verdict of each.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import parser, run, show_table

import habitus as hb
from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError
from habitus.jobs.cameras import fit_cameras
from habitus.observe.camera_rig import CameraRig
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix, up_rotation
from habitus_lab.population.camera_scenes import CameraScene, camera_scene, disturbed

JOINTS = 22
SCENES = {
    "1 camera, height given": {"cameras": 1, "height": True},
    "1 camera, height and floor given": {"cameras": 1, "height": True, "floor": True},
    "2 cameras": {"cameras": 2},
    "4 cameras": {"cameras": 4},
    "8 cameras": {"cameras": 8},
    "4, definitions 15 mm": {"cameras": 4, "definition": 0.015},
    "4, cameras off .5 deg, 2 cm": {"cameras": 4, "off": (0.5, 0.02)},
}


def motion_of(path: Path, frames: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Pose, place (y up) and rate of a capture's busiest stretch."""
    (fit,) = hb.mosh(path)
    stride = max(1, int(fit.rate_hz // 50))
    pose, trans, rate = fit.pose[::stride], fit.trans[::stride], fit.rate_hz / stride
    speed = np.linalg.norm(np.gradient(pose.reshape(len(pose), -1), axis=0), axis=1)
    sums = np.convolve(speed, np.ones(min(frames, len(pose))), "valid")
    first = int(sums.argmax())
    pose, trans = pose[first : first + frames].copy(), trans[first : first + frames]
    turn = up_rotation(fit.up_axis)
    root = fit.body.rest_joints(fit.betas)[0]
    pose[:, 0] = rotvec_from_matrix(turn @ matrix_from_rotvec(pose[:, 0]))
    return pose[:, :24], (trans + root) @ turn.T - root, rate


def scene_of(motion: tuple, seed: int, row: int, **asked: object) -> tuple[CameraScene, CameraRig]:
    """A scene, and the cameras as they are said to be."""
    rng = np.random.default_rng([seed, row])
    off = asked.pop("off", None)
    asked = {key: value for key, value in asked.items() if key not in ("height", "floor")}
    body = hb.load_body(str(rng.choice(["female", "male"])))
    scene = camera_scene(body, *motion, rng=rng, **asked)
    return scene, scene.rig if off is None else disturbed(scene.rig, *off, rng)


def floor_of(scene: CameraScene) -> float:
    """The height (m) at which the person's soles mostly stand."""
    rows = slice(None, None, 5)
    count = len(scene.pose[rows])
    surface = scene.body(np.tile(scene.betas, (count, 1)), scene.pose[rows], scene.trans[rows])
    return float(np.percentile(np.asarray(surface.vertices)[..., 1].min(1), 20))


def errors_of(scene: CameraScene, fit: object) -> dict[str, float]:
    """Distances (mm) of joints and vertices, with and without the whole rig's place."""
    rows = slice(fit.first_frame, fit.first_frame + len(fit.pose))
    surface = scene.body(scene.betas, scene.pose[rows], scene.trans[rows])
    joints = np.asarray(surface.joints)[:, :JOINTS]
    found = fit.body(np.tile(fit.betas, (len(fit.pose), 1)), fit.pose, fit.trans)
    apart = 1e3 * np.linalg.norm(np.asarray(found.joints)[:, :JOINTS] - joints, axis=-1)
    skin = 1e3 * np.linalg.norm(
        np.asarray(found.vertices)[::10] - np.asarray(surface.vertices)[::10], axis=-1
    )
    rest = scene.body.rest_vertices(scene.betas)[:, 1]
    shift = (np.asarray(found.joints)[:, :JOINTS] - joints).mean((0, 1))
    about = np.asarray(found.joints)[:, :JOINTS] - joints
    about = 1e3 * np.linalg.norm(about - about[:, :1], axis=-1)
    placed = 1e3 * np.linalg.norm(np.asarray(found.joints)[:, :JOINTS] - joints - shift, axis=-1)
    return {
        "joints": float(apart.mean()),
        "joints 95 %": float(np.percentile(apart, 95)),
        "skin": float(skin.mean()),
        "placed": float(placed.mean()),
        "about pelvis": float(about.mean()),
        "height cm": 100.0 * float(fit.height - np.ptp(rest)),
    }


def scene_rows(motions: dict[str, tuple], options: argparse.Namespace) -> list[dict]:
    """A row for each motion, kind of scene and seed."""
    rows = []
    for k, (name, motion) in enumerate(motions.items()):
        for kind, asked in SCENES.items():
            for seed in range(options.seeds):
                scene, rig = scene_of(motion, seed, k, **asked)
                rest = scene.body.rest_vertices(scene.betas)[:, 1]
                height = float(np.ptp(rest)) if asked.get("height") else None
                floor = floor_of(scene) if asked.get("floor") else None
                began = time.perf_counter()
                (fit,) = fit_cameras(scene.detections, rig, height=height, floor=floor, up="+y")
                seconds = time.perf_counter() - began
                errors = errors_of(scene, fit)
                rows.append(
                    {"motion": name, "scene": kind, "seed": seed, **errors}
                    | {"verdict": fit.verdict.level, "seconds": seconds}
                    | {"reasons": list(fit.verdict.reasons)}
                )
    return rows


def _exchanged(rig: CameraRig) -> CameraRig:
    one, other, *rest = rig.cameras
    names = one.name, other.name
    return CameraRig((replace(other, name=names[0]), replace(one, name=names[1]), *rest))


def _mirrored(rig: CameraRig) -> CameraRig:
    """Left and right of the world exchanged, with proper rotations."""
    flip = np.diag([-1.0, 1.0, 1.0])
    cameras = []
    for camera in rig.cameras:
        turn = flip @ camera.rotation @ flip
        place = flip @ camera.place
        cameras.append(replace(camera, rotation=turn, translation=-turn @ place))
    return CameraRig(tuple(cameras))


def _scaled(rig: CameraRig, factor: float) -> CameraRig:
    cameras = (replace(c, translation=factor * c.translation) for c in rig.cameras)
    return CameraRig(tuple(cameras))


def _turned(rig: CameraRig, degrees: float) -> CameraRig:
    first, *rest = rig.cameras
    turn = matrix_from_rotvec(np.radians([0.0, degrees, 0.0]))
    return CameraRig((first.moved(turn, np.zeros(3)), *rest))


def spoilt_rows(motions: dict[str, tuple], options: argparse.Namespace) -> list[dict]:
    """The verdict of a copy of a scene with each fault."""
    rows = []
    names = list(motions)
    for k, (name, motion) in enumerate(motions.items()):
        scene, rig = scene_of(motion, 7, k, cameras=4)
        other, _ = scene_of(motions[names[(k + 1) % len(names)]], 8, k, cameras=4)
        seen = scene.detections
        late = seen.pixels.copy()
        late[3:, 0], sure = seen.pixels[:-3, 0], seen.confidence.copy()
        sure[3:, 0] = seen.confidence[:-3, 0]
        frames = min(len(seen.pixels), len(other.detections.pixels))
        strange = replace(
            seen,
            pixels=np.where(
                np.arange(4)[:, None, None, None] == 1,
                other.detections.pixels[:frames], seen.pixels[:frames],
            ),
            confidence=np.where(
                np.arange(4)[:, None, None] == 1,
                other.detections.confidence[:frames], seen.confidence[:frames],
            ),
        )  # fmt: skip
        wrong = replace(seen, convention="openpose25", names=CONVENTIONS["openpose25"])
        spoilt = {
            "none": (seen, rig),
            "wrong convention": (wrong, rig),
            "unit: tenfold": (seen, _scaled(rig, 10.0)),
            "unit: half": (seen, _scaled(rig, 0.5)),
            "cameras exchanged": (seen, _exchanged(rig)),
            "mirrored": (seen, _mirrored(rig)),
            "3 frames late": (replace(seen, pixels=late, confidence=sure), rig),
            "another person": (strange, rig),
            "turned 5 degrees": (seen, _turned(rig, 5.0)),
        }
        for fault, (detections, cameras) in spoilt.items():
            try:
                (fit,) = fit_cameras(detections, cameras)
                level, reason = fit.verdict.level, " ".join(fit.verdict.reasons[:1])
            except HabitusError as error:
                level, reason = "refused", str(error)[:100]
            rows.append({"motion": name, "fault": fault, "verdict": level, "reason": reason})
    return rows


def measure(options: argparse.Namespace) -> dict:
    """All scenes."""
    motions = {path.stem: motion_of(path, options.frames) for path in options.captures}
    rows = scene_rows(motions, options)
    summary = []
    for kind in SCENES:
        own = [row for row in rows if row["scene"] == kind]
        keys = ("joints", "joints 95 %", "skin", "placed", "about pelvis", "seconds")
        means = {key: float(np.mean([row[key] for row in own])) for key in keys}
        height = float(np.sqrt(np.mean([row["height cm"] ** 2 for row in own])))
        good = sum(row["verdict"] == "good" for row in own)
        summary.append(
            {"scene": kind, **means, "height cm RMS": height, "good": good, "of": len(own)}
        )
    return {"summary": summary, "rows": rows, "spoilt": spoilt_rows(motions, options)}


def show(found: dict) -> None:
    """Print the tables."""
    show_table("bodies from cameras, mm", found["summary"], 1)
    table: dict[str, dict] = {}
    for row in found["spoilt"]:
        counts = table.setdefault(
            row["fault"], dict.fromkeys(("good", "doubtful", "failed", "refused"), 0)
        )
        counts[row["verdict"]] += 1
    show_table("verdicts", [{"fault": k, **v} for k, v in table.items()])


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("captures", nargs="+", type=Path)
    arguments.add_argument("--seeds", type=int, default=3)
    arguments.add_argument("--frames", type=int, default=120)
    run(arguments, measure, show)
