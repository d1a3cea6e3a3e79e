"""Does training on registered scans, and registering them again with the trained body, better
either (T 5.4)?

    python benchmarks/coregister.py [--people 4] [--rounds 2] [--out FILE]

Women are drawn from the women's body, which the neutral one knows only in part, each with skin off
it by 4 mm along its normals, the same in all poses. Their scans in three poses are registered, from
nothing, with the default body; a body is trained on these, begun at the default one, its skinning
weights, joints and pose blend shapes held; the same scans are registered with that body, from the
poses that were found. Told of each round: how far surfaces and models are from where every vertex
truly is, how alike the surfaces of one person are (carried back to rest, about their mean), and how
near the body then comes to the same people in a pose that it was not trained on, fitted to the true
surface.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
from dataclasses import replace

import numpy as np
from common import in_words, machine, parser, write_json
from register_scans import full, hidden_vertices, outside
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.body.state import BodyState
from habitus.fit.points.scan import Cloud, Scan
from habitus.fit.points.scan_result import ScanFit
from habitus.fit.points.scan_stage import ScanStage
from habitus.fit.points.scans import Registrar
from habitus.fit.selection.held_out import smooth_field
from habitus.fit.selection.problem import SELECTION
from habitus.jobs.coregister import trained
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.scans import BONY, Scanner, scanned, stance

POSES = ("A", "elbows bent", "step")
UNSEEN = "arms forward"
EXACT = (ScanStage(12, points=100_000, scale=0.1, noise=0.005, slide=1.0),)


def people(options: argparse.Namespace) -> list[dict]:
    """Of each woman true surfaces (m) in all poses, the unseen one last, and scans of all but
    that.
    """
    body = full("female")
    made = []
    bony = [k for k, name in enumerate(body.joint_names) if name.rpartition("_")[2] in BONY]
    for k in range(options.people):
        rng = np.random.default_rng([options.seed, k])
        betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
        off = (
            SELECTION.flesh
            * smooth_field(body.v_template, rng)[:, :1]
            * (1 - 0.75 * body.skinning_weights[:, bony].sum(1))[:, None]
        )
        surfaces = [
            np.asarray(body(betas, stance(pose, body.joint_names, rng)).vertices)
            for pose in (*POSES, UNSEEN)
        ]
        surfaces = [one + off * vertex_normals(one, body.faces) for one in surfaces]
        scans = [
            scanned(one, outside(), Scanner(points=60_000), rng, f"{k} {p}")
            for one, p in zip(surfaces, POSES, strict=False)
        ]
        made.append({"surfaces": surfaces, "scans": scans})
    return made


def distances(surfaces: list[np.ndarray], truths: list[np.ndarray]) -> list[float]:
    """Mean and 95 % (mm) of each surface's vertices from where they are, averaged."""
    counted = ~hidden_vertices(habitus.load_body("default"))
    apart = [
        1e3 * np.linalg.norm(a - b, axis=1)[counted] for a, b in zip(surfaces, truths, strict=True)
    ]
    return [
        float(np.mean([each.mean() for each in apart])),
        float(np.mean([np.percentile(each, 95) for each in apart])),
    ]


def unlike(fits: list[list[ScanFit]]) -> float:
    """Root mean square (mm) of a person's surfaces, at rest, about their mean."""
    counted = ~hidden_vertices(habitus.load_body("default"))
    rest = [np.stack([fit.rest_vertices for fit in each])[:, counted] for each in fits]
    return float(
        np.sqrt(np.mean([((1e3 * (each - each.mean(0))) ** 2).sum(2).mean() for each in rest]))
    )


def in_a_new_pose(
    registrar: Registrar, fits: list[list[ScanFit]], truths: list[np.ndarray]
) -> list[float]:
    """The body with each person's own shape, its pose alone fitted to their true surface in a pose
    not trained on.
    """
    found = []
    for each, true in zip(fits, truths, strict=True):
        true = (
            true[registrar.body.full_vertices] if len(true) != registrar.body.num_vertices else true
        )
        cloud = Cloud(true, vertex_normals(true, registrar.body.faces))
        state = BodyState(each[0].betas, each[0].pose[None], each[0].trans[None])
        (fit,) = registrar.register([Scan("new", true, cloud.normals)], up="+y")
        state = BodyState(each[0].betas, fit.pose[None], fit.trans[None])
        state = registrar.fitter.fit(state, [cloud], (replace(EXACT[0], betas=0),))
        found.append(registrar.fitter.vertices(state))
    return distances(found, truths)


def main() -> None:
    """Run the rounds, print them and write them."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--people", type=int, default=4)
    arguments.add_argument("--rounds", type=int, default=2)
    arguments.add_argument("--seed", type=int, default=88)
    options = arguments.parse_args()
    where = machine()
    console = Console()
    made = people(options)
    default = habitus.load_body("default")
    truths = [[one[default.full_vertices] for one in each["surfaces"]] for each in made]
    body = default
    fits = []
    rounds = []
    for number in range(options.rounds):
        registrar = Registrar.of(body, prior_of(default))
        known = [None] * len(made) if not fits else [before(each, body) for each in fits]
        fits = [
            registrar.register(each["scans"], up="+y", previous=start)
            for each, start in zip(made, known, strict=True)
        ]
        seen = [true for each in truths for true in each[: len(POSES)]]
        row = {
            "body": "default" if number == 0 else f"trained, {body.num_betas} betas",
            "unlike_mm": unlike(fits),
            "surface_mm": distances([fit.vertices for each in fits for fit in each], seen),
            "model_mm": distances([fit.model_vertices for each in fits for fit in each], seen),
            "new_pose_mm": in_a_new_pose(registrar, fits, [each[-1] for each in truths]),
            "verdicts": [fit.verdict.level for each in fits for fit in each],
        }
        rounds.append(row)
        console.print(row)
        if number + 1 < options.rounds:
            people_fits = {f"woman {k}": each for k, each in enumerate(fits)}
            body = trained(registrar.body, people_fits)
    table = Table(
        "round",
        "body",
        "surfaces, mean and 95 %",
        "models",
        "in a new pose",
        "unlike each other, at rest",
        box=None,
    )
    for k, row in enumerate(rounds, 1):
        pairs = (
            "{:.2f}, {:.2f}".format(*row[key]) for key in ("surface_mm", "model_mm", "new_pose_mm")
        )
        table.add_row(str(k), row["body"], *pairs, f"{row['unlike_mm']:.2f}")
    console.print(table)
    console.print(in_words(where))
    write_json(options.out, {"machine": where, "rounds": rounds})


def before(fits: list[ScanFit], body: BodyModel) -> BodyState:
    """Where the round before left a person's scans, with the mean shape of the body."""
    return BodyState(
        np.zeros(body.num_betas),
        np.stack([fit.pose for fit in fits]),
        np.stack([fit.trans for fit in fits]),
    )


if __name__ == "__main__":
    main()
