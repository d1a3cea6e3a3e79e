"""How much of a pose is taken for shape? Rest surfaces of training against the planted ones, and
what it costs.

    python benchmarks/learn_leak.py [--seeds 3] [--vertices 320] [--out FILE]

A registration tells its pose only together with its shape: turning a limb at rest and back in the
pose leaves it as it is. Training takes the pose whose edges are nearest to the mean person's (S eq.
15), and where a shape direction turns edges on average, that turn goes to the pose: rest surfaces
are off by a turn that is linear in the shape coefficients.

Each seed plants a body of five shape directions, trains on 96 poses of 8 people and 120 shapes with
0.5 mm RMS noise, and builds the shape space three times: with the poses found by edges, with the
planted poses, and with poses whose significant regressions on the shape coefficients are taken out.
Reported: distance of rest surfaces from the planted ones (without what they have in common), the
part of it that is linear in the planted coefficients, and what counts: errors of held-out people
(model generalisation) in held-out poses (pose generalisation) against meshes without noise.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from dataclasses import dataclass

import numpy as np
from common import machine, parser, write_json
from rich.console import Console
from rich.table import Table

from habitus.evaluate.generalisation import model_generalisation, pose_generalisation
from habitus.evaluate.posable import PosableBody
from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import body_template
from habitus.learn.assembly import assemble
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.learn.posing.rig import RestPerson
from habitus.learn.posing.surface import pose_normalized
from habitus.learn.shape.shape_space import at_one_root, principal_shapes
from habitus.learn.start.first_estimate import edge_poses
from habitus.learn.train import TrainedBody, train_body
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.planted_body import joints_near_rings, planted_truth
from habitus_lab.population.registrations import Planted, planted_registrations

BETAS = 5
ALONE = Threads(1)


@dataclass(frozen=True, eq=False)
class Case:
    """A training on planted registrations, and those of the shape set."""

    planted: Planted
    template: Template
    trained: TrainedBody
    rows: np.ndarray

    def surfaces(self, pose: np.ndarray) -> np.ndarray:
        """The shape set in the rest pose, given its poses."""
        estimate = self.trained.estimate
        regressor = self.trained.body.joint_regressor
        mean = estimate.templates.mean(0)
        general = RestPerson(mean, regressor @ mean, np.zeros(0))
        data = self.planted.registrations
        return np.stack(
            [
                pose_normalized(estimate.rig, regressor, general, p, data.read(k))
                for k, p in zip(self.rows, pose, strict=True)
            ]
        )

    def found_poses(self) -> np.ndarray:
        """By edges, as training does."""
        estimate = self.trained.estimate
        regressor = self.trained.body.joint_regressor
        mean = estimate.templates.mean(0)
        general = RestPerson(mean, regressor @ mean, np.zeros(0))
        data = self.planted.registrations.take(self.rows)
        return np.stack(
            [fit.pose for fit in edge_poses(estimate.rig, general, self.template.part, data, ALONE)]
        )


def prepare(seed: int, vertices: int) -> Case:
    """Plant and train."""
    base = coarse_body(load_body("default"), vertices)
    template = body_template(base)
    truth = planted_truth(
        base, seed=seed, num_betas=BETAS, joint_regressor=joints_near_rings(template, seed=seed)
    )
    planted = planted_registrations(
        truth,
        subjects=8,
        poses_per_subject=12,
        shape_people=120,
        test_subjects=4,
        test_poses=5,
        noise_rms=5e-4,
        seed=seed,
    )
    options = TrainOptions(
        rounds=3,
        tolerance=0.0,
        num_betas=BETAS,
        regressor="convex",
        weights=EnergyWeights(2.0, pose_shapes=0.3),
    )
    trained = train_body(planted.registrations, template, options, workers=ALONE)
    return Case(
        planted, template, trained, np.flatnonzero(np.array(planted.registrations.set) == "shape")
    )


def uncorrelated(case: Case, pose: np.ndarray) -> np.ndarray:
    """Poses without what of them goes with the shape coefficients, where that is more than
    chance.
    """
    found = pose
    for _ in range(3):
        surfaces = case.surfaces(found)
        betas = principal_shapes(surfaces, BETAS).coefficients(surfaces)
        columns = np.c_[np.ones(len(betas)), betas]
        flat = found.reshape(len(found), -1)
        slopes = np.linalg.lstsq(columns, flat, rcond=None)[0]
        chance = (flat - columns @ slopes).var(0) / (len(betas) - columns.shape[1])
        sure = np.clip(1 - chance / np.maximum(slopes[1:] ** 2, 1e-12), 0, 1)
        found = found - (betas @ (sure * slopes[1:])).reshape(found.shape)
        found[:, 0] = pose[:, 0]
    return found


def measure(case: Case, pose: np.ndarray) -> dict[str, float]:
    """All numbers of one choice of poses (mm)."""
    planted = case.planted
    regressor = case.trained.body.joint_regressor
    surfaces = case.surfaces(pose)
    betas = planted.betas[case.rows]
    rest = planted.surface.rest_vertices(planted.betas[case.rows])
    off = at_one_root(surfaces, regressor, np.zeros(3)) - at_one_root(rest, regressor, np.zeros(3))
    flat = (off - off.mean(0)).reshape(len(off), -1)
    columns = np.c_[np.ones(len(betas)), betas]
    linear = columns @ np.linalg.lstsq(columns, flat, rcond=None)[0]
    rig = case.trained.estimate.rig
    space = principal_shapes(surfaces, BETAS)
    model = PosableBody(assemble("trained", case.template, rig, regressor, space), "trained")
    rows = np.flatnonzero(np.array(planted.registrations.set) == "test")
    test = planted.registrations.take(rows)
    clean = planted.clean[rows]
    free = model_generalisation(model, test, [BETAS], clean=clean)
    fixed = pose_generalisation(model, test, free, clean=clean)
    mean = (1e3 * np.linalg.norm(each.reshape(off.shape), axis=2).mean() for each in (flat, linear))
    numbers = (*mean, 1e3 * free.clean_means[0], 1e3 * fixed.clean_means[0])
    return dict(zip(("rest", "linear", "model", "pose"), map(float, numbers), strict=True))


def main() -> None:
    """Run and write."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--seeds", type=int, default=3)
    arguments.add_argument("--vertices", type=int, default=320)
    options = arguments.parse_args()
    results: dict[str, list[dict[str, float]]] = {}
    for seed in range(options.seeds):
        case = prepare(seed, options.vertices)
        edges = case.found_poses()
        choices = {
            "by edges": edges,
            "planted": case.planted.pose[case.rows],
            "uncorrelated": uncorrelated(case, edges),
        }
        for name, pose in choices.items():
            results.setdefault(name, []).append(measure(case, pose))
    table = Table(title=f"shape taken from poses, mm; means of {options.seeds} seeds")
    for heading in (
        "poses",
        "rest surfaces off",
        "of it linear in shape",
        "model generalisation",
        "pose generalisation",
    ):
        table.add_column(heading)
    for name, found in results.items():
        table.add_row(name, *(f"{np.mean([one[key] for one in found]):.2f}" for key in found[0]))
    Console(width=120).print(table)
    write_json(
        options.out, {"machine": machine(), "vertices": options.vertices, "results": results}
    )


if __name__ == "__main__":
    main()
