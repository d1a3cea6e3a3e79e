"""How fast and how exactly is the whole-sequence marker solve? The pose stage, the soft-tissue
stage, frame by frame.

    python benchmarks/marker_solve.py [--frames 4800] [--runs 7] [--json marker_solve.json]

A known body moves, 41 or 67 markers are seen with 1 mm of noise and 1 % of them missing at 120 Hz;
the solve starts with every joint 12 degrees off (root mean square) and 3 cm away. Initialisation
counts, compilation does not. Gaps are against the same problem solved to 1e-7 rad: cost relative,
pose in degrees between rotations (all joints; the worst joint's mean; the worst single one). Beside
wall-clock medians stands the processor time of all threads together, which other load on the
machine disturbs less: on N free cores the wall-clock time is little more than an Nth of it.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from common import in_words, machine, parser, write_json
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from habitus.body.prior import PosePrior, shipped_prior
from habitus.fit.markers.causal import CausalSolver
from habitus.fit.markers.sequence import SequenceResult, fit_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.observe.marker_prediction import predict
from habitus.observe.marker_rig import MarkerRig, marker_rig
from habitus.observe.markers import attach, default_markers
from habitus.observe.simulated_markers import smooth_motion
from habitus.solve.sequence import SequenceOptions

TIGHT = SequenceOptions(tolerance=1e-7, cost_tolerance=0.0, sweeps=400)


class Scene(NamedTuple):
    """A rig, its prior, what was seen of it (T, M, 3), and where the solve starts."""

    rig: MarkerRig
    prior: PosePrior
    observed: np.ndarray
    pose: np.ndarray
    trans: np.ndarray


def scene(layout_name: str, markers: int, frames: int, flesh: float = 0.0, seed: int = 0) -> Scene:
    """The first `markers` of a layout on a random body in motion; `flesh`: standard deviation of
    its moving betas.
    """
    body = load_body("default")
    layout = load_layout(layout_name)
    rng = np.random.default_rng(seed)
    betas = 0.7 * rng.normal(size=body.num_betas)
    latent = default_markers(
        body, betas, layout.vertices(body)[:markers], layout.distances()[:markers]
    )
    rig = marker_rig(body, betas, attach(latent, body.rest_vertices(betas), body.faces))
    prior = shipped_prior().for_joints(body.joint_names)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), frames, 120.0, rng)
    wobble = (
        flesh
        * np.sin(np.arange(frames) * 2 * np.pi * 2 / 120)[:, None]
        * rng.normal(size=body.num_betas)
    )
    observed = predict(rig, pose, trans, wobble)
    observed += 0.001 * rng.normal(size=observed.shape)
    observed[rng.random(observed.shape[:2]) < 0.01] = np.nan
    off = rng.normal(size=pose.shape) * np.radians(12) / np.sqrt(3)
    return Scene(rig, prior, observed, pose + off, trans + 0.03 * rng.normal(size=trans.shape))


def timed(run, runs: int) -> tuple[Any, float, float]:
    """The result, the median of wall-clock seconds and the least processor time of all threads."""
    walls = []
    processor = []
    for _ in range(runs):
        began = time.perf_counter()
        spent = time.process_time()
        result = run()
        walls.append(time.perf_counter() - began)
        processor.append(time.process_time() - spent)
    return result, median(walls), min(processor)


def row(stage: str, s: Scene, found, tight, wall: float, processor: float) -> dict:
    """One line of the table."""
    frames, markers = s.observed.shape[:2]
    shape = found.pose.shape[:2]
    turn = Rotation.from_rotvec(found.pose.reshape(-1, 3)).inv() * Rotation.from_rotvec(
        tight.pose.reshape(-1, 3)
    )
    degrees = np.degrees(turn.magnitude()).reshape(shape)
    return {
        "stage": stage,
        "markers": markers,
        "frames": frames,
        "frames_per_second": frames / wall,
        "processor_us_per_frame": 1e6 * processor / frames,
        "cost_gap": sum(found.costs.values()) / sum(tight.costs.values()) - 1.0,
        "pose_gap_degrees": {
            "rms": float(np.sqrt(np.mean(degrees**2))),
            "worst_joint_rms": float(np.sqrt(np.mean(degrees**2, axis=0)).max()),
            "max": float(degrees.max()),
        },
        "sweeps": found.iterations,
        "status": found.status,
    }


def stage(name: str, s: Scene, betas: int, runs: int) -> tuple[dict, SequenceResult]:
    """Time a stage and compare it with the tight optimum."""
    soft = np.zeros((len(s.observed), betas)) if betas else None

    def run(settings: SequenceSettings, part: slice = slice(None)) -> SequenceResult:
        start = (s.pose[part], s.trans[part], settings, None if soft is None else soft[part])
        return fit_sequence(s.rig, s.observed[part], None, None, s.prior, *start)

    settings = SequenceSettings()
    run(settings, slice(0, 100))
    found, wall, processor = timed(lambda: run(settings), runs)
    tight = run(replace(settings, options=TIGHT))
    return row(name, s, found, tight, wall, processor), tight


def causal(s: Scene, tight: SequenceResult) -> dict:
    """Milliseconds a frame, one after another, called from Python; and how far from the whole
    sequence's optimum.
    """
    solver = CausalSolver(s.rig, s.prior, s.pose[0], s.trans[0])
    solver.step(s.observed[0])
    seconds = np.empty(len(s.observed) - 1)
    poses = []
    for k, markers in enumerate(s.observed[1:]):
        began = time.perf_counter()
        poses.append(solver.step(markers).pose)
        seconds[k] = time.perf_counter() - began
    turn = Rotation.from_rotvec(np.reshape(poses, (-1, 3))).inv() * Rotation.from_rotvec(
        tight.pose[1:].reshape(-1, 3)
    )
    return {
        "markers": s.rig.num_markers,
        "median_ms": 1e3 * float(np.median(seconds)),
        "p99_ms": 1e3 * float(np.percentile(seconds, 99)),
        "pose_gap_degrees_rms": float(np.degrees(np.sqrt(np.mean(turn.magnitude() ** 2)))),
    }


def show(stages: list[dict], causals: list[dict], where: str) -> None:
    """Print the tables."""
    table = Table(
        "stage",
        "markers",
        "frames/s",
        "cpu us/frame",
        "cost gap",
        "pose gap: rms",
        "worst joint",
        "max",
        "status",
    )
    for r in stages:
        gap = r["pose_gap_degrees"]
        speed = (
            f"{r['frames_per_second']:,.0f}",
            f"{r['processor_us_per_frame']:.0f}",
            f"{r['cost_gap']:.1e}",
        )
        degrees = (f"{gap['rms']:.3f}°", f"{gap['worst_joint_rms']:.3f}°", f"{gap['max']:.2f}°")
        table.add_row(r["stage"], str(r["markers"]), *speed, *degrees, r["status"])
    console = Console(width=130)
    console.print(where)
    console.print(table)
    for r in causals:
        console.print(
            f"causal, {r['markers']} markers: {r['median_ms']:.2f} ms a frame (median), "
            f"{r['p99_ms']:.2f} ms (99 %), "
            f"{r['pose_gap_degrees_rms']:.2f}° from the whole sequence's optimum"
        )


def main() -> None:
    """Run everything."""
    arguments = parser(__doc__)
    arguments.add_argument("--frames", type=int, default=4800)
    arguments.add_argument("--runs", type=int, default=7)
    arguments.add_argument("--json", type=Path, default=Path("marker_solve.json"))
    options = arguments.parse_args()
    here = machine()
    stages = []
    causals = []
    for layout_name, markers in (("cmu-41", 41), ("mosh-67", 67)):
        s = scene(layout_name, markers, options.frames)
        pose, tight = stage("pose", s, 0, options.runs)
        fleshy = scene(layout_name, markers, options.frames, flesh=0.3)
        begun = fit_sequence(
            fleshy.rig, fleshy.observed, None, None, fleshy.prior, fleshy.pose, fleshy.trans
        )
        soft, _ = stage(
            "soft tissue",
            fleshy._replace(pose=begun.pose, trans=begun.trans),
            s.rig.num_betas,
            options.runs,
        )
        stages += [pose, soft]
        causals.append(causal(s, tight))
    show(stages, causals, in_words(here))
    write_json(options.json, {"machine": here, "stages": stages, "causal": causals})


if __name__ == "__main__":
    main()
