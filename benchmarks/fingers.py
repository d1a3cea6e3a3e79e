"""How well do fits follow fingers: with 14 markers a hand, with the tips only, with three tips.

    python benchmarks/fingers.py [--frames 60] [--noise 0.0005] [--captures 3] [--out FILE.json]

A person with drawn betas moves as the pose prior has it; the hands go from one of `HAND_POSES` to
the next, every joint of a finger besides up to 12 degrees beside it (a sine of its own). Labels and
layout are the capture's own, written as TRC and TOML; body markers sit 5 mm beside their places,
finger markers 1 mm. ``mosh`` runs with ``joints="auto"``, beside it with 24 joints on all markers
and on those of the body alone.

joint_deg: angle between a finger joint's fitted and true rotation; tip_mm: fingertips' distance
from the true ones; wrist_mm, elbow_mm: of those joints. Means over frames.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import parser, run, show_table
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.hands import FINGERS, HAND_POSES, SIDES, HandPose, hand_pose
from habitus.body.model import BodyModel
from habitus.body.prior import shipped_prior
from habitus.export.trc import write_trc
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.io.layouts.toml import layout_text
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.observe.markers import attach, predict_markers
from habitus.observe.simulated_markers import misplace, smooth_motion

RATE = 60.0
HOLD_S = 0.4
SETS = {
    "14 a hand": ("thumb_ip", *(f"{f}_{p}" for f in FINGERS for p in ("pip", "dip"))),
    "5 tips": (),
    "3 tips": None,
}
TIPS = tuple(f"{finger}_tip" for finger in ("thumb", *FINGERS))


def finger_markers(places: tuple[str, ...]) -> tuple[Marker, ...]:
    """Markers on places of both hands, with labels of their own."""
    return tuple(
        Marker(
            f"{side[0].upper()}G{k:02d}",
            landmark=f"{side}_{place}",
            distance=0.004,
            place_spread=0.003,
        )
        for side in SIDES
        for k, place in enumerate(places)
    )


def own_layout(fingers: tuple[Marker, ...]) -> MarkerLayout:
    """The body markers of cmu-41 under other labels, and finger markers."""
    known = load_layout("cmu-41")
    body = tuple(
        replace(marker, label=f"P{k:03d}", aliases=(), distance_spread=0.002)
        for k, marker in enumerate(known.markers)
    )
    return MarkerLayout("own", (*body, *fingers))


def moving_hands(body: BodyModel, frames: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Rotation vectors (T, 3) of the finger joints."""
    names = list(HAND_POSES)
    seconds = np.arange(frames) / RATE
    found: dict[str, list] = {}
    for side in SIDES:
        order = rng.permutation(names)
        when = (seconds / HOLD_S) % len(order)
        wave = rng.uniform(0.2, 0.8, (5, 3)), rng.uniform(0, 2 * np.pi, (5, 3))
        for t in range(frames):
            k = int(when[t])
            share = 0.5 - 0.5 * np.cos(np.pi * (when[t] - k))
            more = 12.0 * np.sin(2 * np.pi * wave[0] * seconds[t] + wave[1])
            pose = _between(
                HAND_POSES[order[k]], HAND_POSES[order[(k + 1) % len(order)]], share, more
            )
            for name, turn in hand_pose(body, pose, (side,)).items():
                found.setdefault(name, []).append(turn)
    return {name: np.array(turns) for name, turns in found.items()}


def _between(a: HandPose, b: HandPose, share: float, more: np.ndarray) -> HandPose:
    def mixed(name: str) -> np.ndarray:
        return (1 - share) * np.array(getattr(a, name)) + share * np.array(getattr(b, name))

    angles = {
        name: tuple(mixed(name) + add) for name, add in zip((*FINGERS, "thumb"), more, strict=True)
    }
    return HandPose(**angles, abduction=float(mixed("abduction")), spread=tuple(mixed("spread")))


def simulated(body: BodyModel, layout: MarkerLayout, options: argparse.Namespace, seed: int):
    """A capture of moving hands with these markers, and the motion behind it."""
    rng = np.random.default_rng(seed)
    prior = shipped_prior().for_joints(body.joint_names)
    pose, trans = smooth_motion(
        prior.mean, 0.5 * np.sqrt(np.diag(prior.covariance)), options.frames, RATE, rng
    )
    for name, turns in moving_hands(body, options.frames, rng).items():
        pose[:, body.joint_names.index(name)] = turns
    betas = np.clip(rng.normal(size=body.num_betas), -2, 2)
    on_finger = np.array([marker.place_spread < 0.005 for marker in layout.markers])
    vertices, distances = layout.vertices(body), layout.distances()
    latent = np.where(
        on_finger[:, None],
        misplace(body, betas, vertices, distances, 0.001, rng),
        misplace(body, betas, vertices, distances, 0.005, rng),
    )
    truth = body(betas, pose, trans)
    markers = predict_markers(truth.vertices, attach(latent, body.rest_vertices(betas), body.faces))
    markers = markers + options.noise * rng.normal(size=markers.shape)
    return Capture("hands", layout.labels, markers, RATE, "+y"), pose, truth


def errors(fit, body: BodyModel, pose: np.ndarray, truth) -> dict[str, float]:
    """Of a fit from the truth, of each kind that its joints have."""
    names = fit.body.joint_names
    joints = fit.joints()
    tips = [body.landmarks[f"{side}_{tip}"] for side in SIDES for tip in TIPS]
    vertices = np.asarray(fit.body(fit.betas, fit.pose, fit.trans, vertices=tips).vertices)
    off = {
        "joint_deg": None,
        "tip_mm": 1e3 * np.linalg.norm(vertices - truth.vertices[:, tips], axis=2).mean(),
    }
    for part in ("wrist", "elbow"):
        off[f"{part}_mm"] = 1e3 * np.mean(
            [
                np.linalg.norm(
                    joints[:, names.index(f"{side}_{part}")]
                    - truth.joints[:, body.joint_names.index(f"{side}_{part}")],
                    axis=1,
                )
                for side in SIDES
            ]
        )
    if "left_index1" in names:
        fingers = [f"{s}_{f}{k}" for s in SIDES for f in (*FINGERS, "thumb") for k in (1, 2, 3)]
        a, b = (
            Rotation.from_rotvec(p[:, [n.index(f) for f in fingers]].reshape(-1, 3))
            for p, n in ((fit.pose, names), (pose, body.joint_names))
        )
        off["joint_deg"] = float(np.degrees((a.inv() * b).magnitude()).mean())
    return off | {"joints": len(names)}


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Fits of simulated captures, a row for each set of finger markers and way of fitting."""
    body = hb.load_body("default", joints="smplh")
    rows = []
    for name, more in SETS.items():
        tips = TIPS if more is not None else tuple(TIPS[k] for k in (0, 1, 4))
        layout = own_layout(finger_markers((*tips, *(more or ()))))
        ways = {"auto": ("auto", layout)}
        if more:
            bare = own_layout(())
            ways |= {"24 joints": ("smpl", layout), "24 joints, no finger markers": ("smpl", bare)}
        for way, (joints, taken) in ways.items():
            found = []
            for seed in range(options.captures):
                capture, pose, truth = simulated(body, layout, options, seed)
                found.append(errors(_fitted(capture, taken, joints), body, pose, truth))
            rows.append(
                {"markers": name, "fit": way}
                | {
                    key: None if found[0][key] is None else float(np.mean([f[key] for f in found]))
                    for key in found[0]
                }
            )
    return {"rows": rows}


def _fitted(capture: Capture, layout: MarkerLayout, joints):
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "hands.trc", Path(folder) / "own.toml"
        write_trc(capture, files[0])
        files[1].write_text(layout_text(layout), encoding="utf-8")
        return hb.Mosh(layout=files[1], joints=joints, soft_tissue=False).fit(files[0])


def show(found: dict) -> None:
    """The rows."""
    show_table("Fingers in marker fits", found["rows"])


if __name__ == "__main__":
    arguments = parser(__doc__)
    arguments.add_argument("--frames", type=int, default=60)
    arguments.add_argument("--noise", type=float, default=5e-4)
    arguments.add_argument("--captures", type=int, default=3)
    arguments.add_argument("--out", type=Path)
    run(arguments, measure, show)
