"""Does training find what was planted? Registrations from a model of SMPL's form with noise,
learned from and held out.

    python benchmarks/learn_planted.py [--size toy|middle|papers] [--share 0.5] [--off 10] [--threads 2] [--rounds N]
                                       [--out FILE]

The truth is the default body with planted pose blend shapes, its own skinning weights and shape
directions, and joints about 10 mm (--off) from the rings that training starts from. Registrations
carry noise of 1 mm RMS distance and are read from disk. `papers` has the papers' size: 40 subjects
in 1,786 poses, 3,800 shapes, 7,099 vertices, and 120 held-out meshes of six other people; weights
are the papers'. The smaller sizes scale lambda_P with the number of registrations and lambda_J with
the number of vertices, as the data term against which they were chosen.

Reported: errors of held-out poses and people against noisy and noise-free meshes (model and pose
generalisation, S
5.1), distances from planted joints, whether the energy ever rose, seconds of every stage, memory.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import resource
import tempfile
import time
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from common import machine, parser, write_json
from rich.console import Console
from rich.table import Table

from habitus.evaluate.generalisation import model_generalisation, pose_generalisation
from habitus.evaluate.posable import PosableBody
from habitus.io.models.bodies import load_body, save_body
from habitus.io.registrations.templates import body_template
from habitus.learn.callback import Record, TrainingState
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.learn.posing.surface import skeleton
from habitus.learn.train import TrainedBody, train_body
from habitus.parallel.workers import Threads
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.planted_body import joints_near_rings, planted_truth
from habitus_lab.population.registrations import PAPERS_SIZE, Planted, planted_registrations

GOALS = {"noisy": 1.3, "clean": 0.8, "joints": 5.0, "hours": 3.0, "gigabytes": 8.0}
SIZES: dict[str, dict[str, Any]] = {
    "toy": {"vertices": 600, "subjects": 6, "poses_per_subject": 20, "shape_people": 60},
    "middle": {"vertices": 1200, "subjects": 20, "poses_per_subject": 45, "shape_people": 400},
    "papers": {"vertices": None, **PAPERS_SIZE},
}


@dataclass
class Clock:
    """Prints what happens, and keeps when."""

    console: Console
    registrations: int
    vertices: int
    begun: float = field(default_factory=time.perf_counter)
    seconds: dict[str, float] = field(default_factory=dict)
    surfaces: np.ndarray | None = None

    def on_step_end(self, record: Record) -> None:
        """One line a step."""
        energy = record.energy
        now = time.perf_counter() - self.begun
        rms = 1e3 * (energy.terms["data"] / self.registrations / self.vertices) ** 0.5
        self.seconds["poses by edges" if record.round == 0 else "alternation"] = now
        self.console.print(
            f"{record.round} {record.step:15} {energy.total:12.5f}  data {rms:.3f} mm RMS  "
            f"{now:.0f} s"
        )

    def on_state(self, state: TrainingState) -> None:
        """Nothing."""

    def on_round_end(self, state: TrainingState) -> None:
        """Nothing."""

    def surface_store(self, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
        """32-bit numbers in memory."""
        self.surfaces = np.empty(shape, np.float32)
        return self.surfaces, 0

    def on_surfaces_stored(self, count: int) -> None:
        """The shape stage goes on."""
        self.seconds["shapes"] = time.perf_counter() - self.begun


def plant(size: str, share: float, off: float, folder: Path, seed: int) -> tuple[Any, Planted]:
    """The template and the planted registrations, on disk; ``share`` of the poses and shapes,
    joints ``off`` mm.
    """
    wanted = dict(SIZES[size])
    poses = np.broadcast_to(wanted["poses_per_subject"], wanted["subjects"])
    wanted["poses_per_subject"] = tuple(round(share * int(n)) for n in poses)
    wanted["shape_people"] = round(share * wanted["shape_people"])
    count = wanted.pop("vertices")
    body = (
        replace(load_body("default"), posedirs=None)
        if count is None
        else coarse_body(load_body("default"), count)
    )
    template = body_template(body)
    truth = planted_truth(
        body, seed=seed, joint_regressor=joints_near_rings(template, seed=seed, offset=1e-3 * off)
    )
    planted = planted_registrations(
        truth, **wanted, test_subjects=6, test_poses=20, seed=seed, out=folder / "data"
    )
    return template, planted


def options_for(size: str, planted: Planted, rounds: int) -> TrainOptions:
    """The papers' weights; at other sizes scaled as the data term is."""
    if size == "papers":
        return TrainOptions(rounds=rounds)
    poses = planted.registrations.set.count("pose")
    weights = EnergyWeights(
        joints=100 * planted.registrations.num_vertices / 6890, pose_shapes=25 * poses / 1786
    )
    return TrainOptions(rounds=rounds, weights=weights)


def joint_errors(
    planted: Planted, rows: np.ndarray, joints: np.ndarray, pose: np.ndarray, trans: np.ndarray
):
    """Mean distance (mm) of each joint from where it was planted, in the poses of those
    registrations.
    """
    parents = planted.surface.parents
    of = planted.registrations.subject_index
    found = [
        skeleton(parents, p).positions(j) + t for j, p, t in zip(joints, pose, trans, strict=True)
    ]
    truth = [
        skeleton(parents, planted.pose[k]).positions(planted.joints[of[k]]) + planted.trans[k]
        for k in rows
    ]
    return 1e3 * np.linalg.norm(np.stack(found) - np.stack(truth), axis=-1).mean(0)


def held_out(trained: TrainedBody, planted: Planted, threads: int) -> dict[str, Any]:
    """Model and pose generalisation on the test set (mm), and joints."""
    rows = np.flatnonzero(np.array(planted.registrations.set) == "test")
    test = planted.registrations.take(rows)
    clean = planted.clean[rows]
    model = PosableBody(trained.body, "trained")
    count = trained.body.num_betas
    workers = Threads(threads)
    free = model_generalisation(model, test, [count], clean=clean, workers=workers)
    fixed = pose_generalisation(model, test, free, clean=clean, workers=workers)
    joints = trained.body.rest_joints(free.betas[0])
    return {
        "model_generalisation_mm": {
            "noisy": 1e3 * free.means[0],
            "clean": 1e3 * free.clean_means[0],
        },
        "pose_generalisation_mm": {
            "noisy": 1e3 * fixed.means[0],
            "clean": 1e3 * fixed.clean_means[0],
        },
        "joints_mm": joint_errors(planted, rows, joints, free.pose[0], free.trans[0]).tolist(),
    }


def keep_body(trained: TrainedBody, path: Path | None) -> None:
    """For pictures."""
    if path is not None:
        save_body(trained.body, path)


def measure(arguments: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Plant, train, hold against the truth."""
    size = arguments.size
    threads = arguments.threads
    with tempfile.TemporaryDirectory() as folder:
        template, planted = plant(
            size, arguments.share, arguments.off, Path(folder), arguments.seed
        )
        registrations = planted.registrations
        poses = np.flatnonzero(np.array(registrations.set) == "pose")
        clock = Clock(console, len(poses), registrations.num_vertices)
        begun = time.perf_counter(), time.process_time()
        options = options_for(size, planted, arguments.rounds)
        trained = train_body(
            registrations, template, options, workers=Threads(threads), callback=clock
        )
        wall = time.perf_counter() - begun[0]
        cpu = time.process_time() - begun[1]
        keep_body(trained, arguments.keep)
        estimate = trained.estimate
        of = registrations.where(set="pose").subject_index
        energies = [record.energy.total for record in trained.history]
        return {
            "registrations": len(poses),
            "shapes": registrations.set.count("shape"),
            "vertices": registrations.num_vertices,
            "rounds": trained.history[-1].round,
            "seconds": {**clock.seconds, "all": wall, "cpu": cpu},
            "peak_gigabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
            "energy": [
                {"round": r.round, "step": r.step, **r.energy.terms} for r in trained.history
            ],
            "energy_rose": any(b > a * (1 + 1e-12) for a, b in pairwise(energies)),
            "weights_off": float(
                np.abs(estimate.rig.weights - planted.surface.skinning_weights).sum(1).mean()
            ),
            "common_turn_degrees": np.degrees(
                np.linalg.norm((estimate.pose - planted.pose[poses]).mean(0), axis=-1)
            ).tolist(),
            "joint_names": template.joint_names,
            "training_joints_mm": joint_errors(
                planted, poses, estimate.joints[of], estimate.pose, estimate.trans
            ).tolist(),
            **held_out(trained, planted, threads),
        }


def table(result: dict[str, Any]) -> Table:
    """What was asked for, as measured."""
    out = Table(title="planted truth, 1 mm RMS noise")
    for heading in ("", "measured", "goal"):
        out.add_column(heading)
    for kind in ("model", "pose"):
        found = result[f"{kind}_generalisation_mm"]
        for against in ("noisy", "clean"):
            out.add_row(
                f"{kind} generalisation, {against}, mm",
                f"{found[against]:.3f}",
                str(GOALS[against]),
            )
    for which in ("training_joints_mm", "joints_mm"):
        joints = np.array(result[which])[
            1:
        ]  # where the root's joint is, no pose can tell: place makes up for it
        worst = result["joint_names"][1 + int(joints.argmax())]
        out.add_row(
            which,
            f"mean {joints.mean():.2f}, worst {joints.max():.2f} ({worst})",
            str(GOALS["joints"]),
        )
    out.add_row("energy rose", str(result["energy_rose"]), "False")
    out.add_row("hours", f"{result['seconds']['all'] / 3600:.2f}", str(GOALS["hours"]))
    out.add_row("CPU hours", f"{result['seconds']['cpu'] / 3600:.2f}", "")
    out.add_row("gigabytes at most", f"{result['peak_gigabytes']:.2f}", str(GOALS["gigabytes"]))
    return out


def main() -> None:
    """Run and write."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--size", choices=SIZES, default="toy")
    arguments.add_argument(
        "--share", type=float, default=1.0, help="of the size's poses and shapes"
    )
    arguments.add_argument(
        "--off", type=float, default=10.0, help="mm from the rings to the planted joints"
    )
    arguments.add_argument("--threads", type=int, default=2)
    arguments.add_argument("--rounds", type=int, default=8)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--keep", type=Path, help="write the trained body here")
    options = arguments.parse_args()
    console = Console()
    result = measure(options, console)
    console.print(table(result))
    told = {key: getattr(options, key) for key in ("size", "share", "off", "seed", "threads")}
    write_json(options.out, {"machine": machine(), **told, **result})


if __name__ == "__main__":
    main()
