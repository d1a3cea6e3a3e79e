"""What do pose blend shapes buy on surfaces that no model can hold? SMPL, plain skinning,
BlendSCAPE on the same data.

    python benchmarks/learn_out_of_class.py [--people papers] [--vertices 600] [--models ...]
                                            [--keep DIR] [--out learn_out_of_class.json]

Registrations come from dual quaternion skinning plus bulges that follow joint angles in a way that
rotation matrices do
not span, and that grow with a person's girth (`habitus_lab.population.bulging_flesh`), with noise of 1
mm RMS. Every
model is trained on the same registrations, held-out poses of held-out people are fitted (S 5.1).
Errors are mean
distances of vertices from noisy and from noise-free meshes; shares removed are against the
noise-free ones, since
noise alone is 0.92 mm. Models: SMPL-LBS and SMPL-DQBS; the same without their pose blend shapes, as
S 5.1 compares;
plain skinning trained as such; sparse (S 5.2), of low rank, with L1, shape-dependent (T 5.6); other
pose features (T
5.6) with the neck twist; BlendSCAPE from the poses and weights of SMPL-LBS, as published and
trained through its
stitching. `--people papers`: 40 subjects in 1,786 poses and 3,800 shapes (S 4). The file is written
after each model.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import machine, parser, write_json
from rich.console import Console
from rich.table import Table

from habitus.evaluate.generalisation import model_generalisation, pose_generalisation
from habitus.evaluate.neck_twist import neck_twist
from habitus.evaluate.posable import Posable, PosableBody, without_pose_shapes
from habitus.io.models.bodies import load_body, save_body
from habitus.io.registrations.open import write_registrations
from habitus.io.registrations.templates import body_template
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.learn.train import TrainedBody, poses_of, train_body
from habitus.parallel.workers import Threads
from habitus_lab.baselines.blendscape_training import train_blendscape
from habitus_lab.baselines.files import save_blendscape
from habitus_lab.population.bulging_flesh import out_of_class_surface
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.planted_body import joints_near_rings
from habitus_lab.population.registrations import PAPERS_SIZE, Planted, planted_registrations

VARIANTS: dict[str, dict[str, Any]] = {
    "SMPL-LBS": {},
    "SMPL-DQBS": {"skinning": "dqbs"},
    "plain LBS": {"pose_shapes": "none"},
    "plain DQBS": {"skinning": "dqbs", "pose_shapes": "none"},
    "SMPL-LBS-Sparse": {"pose_shapes": "sparse"},
    "rank 32": {"pose_shapes": "low_rank", "rank": 32},
    "L1": {"pose_shapes": "l1"},
    "shape-dependent": {"shape_features": 2},
    "angles": {"pose_features": "angles"},
    "sin_cos": {"pose_features": "sin_cos"},
    "quaternions": {"pose_features": "quaternions"},
    "polynomials": {"pose_features": "polynomials"},
}
BLENDSCAPE = {"BlendSCAPE": 0, "BlendSCAPE through stitching": 6}
PEOPLE: dict[str, dict[str, Any]] = {
    "few": {"subjects": 16, "poses_per_subject": 40, "shape_people": 200},
    "papers": PAPERS_SIZE,
}
FEATURES = ("SMPL-LBS", "angles", "sin_cos", "quaternions", "polynomials")


def plant(arguments: argparse.Namespace, folder: Path) -> tuple[Any, Planted]:
    """The template, and registrations of surfaces outside the class; joints are as near the rings
    as planted ones.
    """
    body = coarse_body(load_body("default"), arguments.vertices)
    regressor = joints_near_rings(body_template(body), seed=arguments.seed)
    body = replace(body, joint_regressor=regressor)
    planted = planted_registrations(
        out_of_class_surface(body),
        **PEOPLE[arguments.people],
        test_subjects=6,
        test_poses=10,
        seed=arguments.seed,
        out=folder / "data",
    )
    return body_template(body), planted


def options_for(planted: Planted, rounds: int, chosen: dict[str, Any]) -> TrainOptions:
    """The papers' weights, scaled as the data term is: there are fewer registrations and vertices
    here.
    """
    poses = planted.registrations.set.count("pose")
    scale = planted.registrations.num_vertices / 6890
    weights = EnergyWeights(joints=100 * scale, pose_shapes=25 * poses / 1786)
    return TrainOptions(rounds=rounds, weights=weights, num_betas=10, **chosen)


def errors_of(model: Posable, planted: Planted, arguments: argparse.Namespace) -> dict[str, Any]:
    """Both measures (mm) at each number of shape coefficients."""
    counts = arguments.counts
    threads = arguments.threads
    rows = np.flatnonzero(np.array(planted.registrations.set) == "test")
    test = planted.registrations.take(rows)
    clean = planted.clean[rows]
    workers = Threads(threads)
    free = model_generalisation(model, test, counts, clean=clean, workers=workers)
    fixed = pose_generalisation(model, test, free, clean=clean, workers=workers)
    return {
        "counts": list(free.counts),
        "model": {"noisy": (1e3 * free.means).tolist(), "clean": (1e3 * free.clean_means).tolist()},
        "pose": {
            "noisy": (1e3 * fixed.means).tolist(),
            "clean": (1e3 * fixed.clean_means).tolist(),
        },
    }


def keep_held_out(planted: Planted, folder: Path) -> None:
    """The test meshes, with noise and without: `habitus evaluate MODEL... held-out.npz` draws the
    papers' figures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = np.flatnonzero(np.array(planted.registrations.set) == "test")
    test = planted.registrations.take(rows)
    write_registrations(test, folder / "held-out.npz")
    write_registrations(replace(test, vertices=planted.clean[rows]), folder / "held-out-clean.npz")


def measure(
    arguments: argparse.Namespace, folder: Path, console: Console
) -> Iterator[dict[str, Any]]:
    """Train every model and hold it against the test meshes; what is known, after each."""
    template, planted = plant(arguments, folder)
    if arguments.keep:
        keep_held_out(planted, arguments.keep)
    registrations = planted.registrations
    workers = Threads(arguments.threads)
    found: dict[str, Any] = {}
    trained: dict[str, TrainedBody] = {}
    for name in [name for name in VARIANTS if name in arguments.models]:
        begun = time.process_time(), time.perf_counter()
        options = options_for(planted, arguments.rounds, VARIANTS[name])
        trained[name] = train_body(registrations, template, options, workers=workers)
        found[name] = seconds_since(*begun) | errors_of(
            PosableBody(trained[name].body, name), planted, arguments
        )
        if name in ("SMPL-LBS", "SMPL-DQBS"):
            bare = PosableBody(without_pose_shapes(trained[name].body), f"{name} without P")
            found[bare.name] = errors_of(bare, planted, arguments)
        if name in FEATURES:
            twist = neck_twist([trained[name].body])[0]  # T 5.6, Fig. 5-16
            found[name]["neck_twist"] = {"asymmetry": twist.asymmetry, "shrink": twist.shrink}
        if arguments.keep:
            save_body(trained[name].body, arguments.keep / f"{name.replace(' ', '-')}.npz")
        report(console, found, name)
        yield found
    for name in [name for name in BLENDSCAPE if name in arguments.models]:
        begun = time.process_time(), time.perf_counter()
        smpl = trained["SMPL-LBS"]
        known = registrations.where(set=("pose", "shape"))
        model = train_blendscape(
            known,
            template,
            poses_of(smpl, template, known, workers),
            smpl.estimate.rig.weights,
            num_betas=max(arguments.counts),
            through_stitching=BLENDSCAPE[name],
            name=name,
            workers=workers,
        )
        found[name] = seconds_since(*begun) | errors_of(model, planted, arguments)
        if arguments.keep:
            save_blendscape(model, arguments.keep / f"{name.replace(' ', '-')}.npz")
        report(console, found, name)
        yield found


def seconds_since(cpu: float, wall: float) -> dict[str, float]:
    """CPU and wall seconds."""
    return {"cpu_seconds": time.process_time() - cpu, "seconds": time.perf_counter() - wall}


def report(console: Console, found: dict[str, Any], name: str) -> None:
    """One line a model."""
    row = found[name]
    last = row["counts"].index(max(row["counts"]))
    console.print(
        f"{name:30} model {row['model']['noisy'][last]:.3f} / {row['model']['clean'][last]:.3f}   "
        f"pose {row['pose']['noisy'][last]:.3f} / {row['pose']['clean'][last]:.3f}   "
        f"{row.get('seconds', 0):.0f} s"
    )


def removed(found: dict[str, Any]) -> dict[str, float]:
    """Shares of plain skinning's pose-generalisation error that pose blend shapes remove
    (noise-free meshes).
    """
    out = {}
    for full, plains in (
        ("SMPL-LBS", ("plain LBS", "SMPL-LBS without P")),
        ("SMPL-DQBS", ("plain DQBS", "SMPL-DQBS without P")),
    ):
        for plain in plains:
            if full in found and plain in found:
                errors = [found[name]["pose"]["clean"][-1] for name in (full, plain)]
                out[f"{full} against {plain}"] = 1 - errors[0] / errors[1]
    return out


def table(found: dict[str, Any]) -> Table:
    """All models side by side, with all their shape coefficients."""
    out = Table(title="outside the class, mm against noisy / noise-free meshes")
    for heading in ("", "model generalisation", "pose generalisation", "training, s"):
        out.add_column(heading)
    for name, row in found.items():
        cells = [
            f"{row[kind]['noisy'][-1]:.3f} / {row[kind]['clean'][-1]:.3f}"
            for kind in ("model", "pose")
        ]
        out.add_row(name, *cells, f"{row['seconds']:.0f}" if "seconds" in row else "")
    return out


def main() -> None:
    """Run and write."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--vertices", type=int, default=600)
    arguments.add_argument("--people", choices=PEOPLE, default="few")
    arguments.add_argument("--rounds", type=int, default=6)
    arguments.add_argument("--counts", type=int, nargs="+", default=[1, 2, 5, 10])
    arguments.add_argument("--models", nargs="+", default=[*VARIANTS, *BLENDSCAPE])
    arguments.add_argument("--threads", type=int, default=2)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--keep", type=Path, help="write models and test meshes here")
    options = arguments.parse_args()
    if {*BLENDSCAPE} & {*options.models} and "SMPL-LBS" not in options.models:
        options.error("BlendSCAPE takes the poses and weights of SMPL-LBS: ask for that as well")
    unknown = {*options.models} - {*VARIANTS, *BLENDSCAPE}
    if unknown:
        options.error(
            f"no models {', '.join(sorted(unknown))}; expected some of "
            f"{', '.join([*VARIANTS, *BLENDSCAPE])}"
        )
    console = Console()
    told = {key: value for key, value in vars(options).items() if key not in ("out", "keep")}
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for found in measure(options, Path(folder), console):
            write_json(
                options.out,
                {"machine": machine(), **told, "models": found, "removed": removed(found)},
            )
    console.print(table(found))
    for name, row in found.items():
        if "neck_twist" in row:
            console.print(f"neck twist, {name}: {row['neck_twist']}")
    for name, share in removed(found).items():
        console.print(f"{name}: {100 * share:.0f} % of the error removed")


if __name__ == "__main__":
    main()
