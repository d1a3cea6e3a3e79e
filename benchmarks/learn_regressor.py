"""Joints of new people: convex regressors (S 4.1) against signed ones, on the default body with its
own joints.

    python benchmarks/learn_regressor.py [--people 20 40] [--noise 5] [--out FILE]

Rest surfaces of people are drawn from the shape space; their joints are those of the body's own
regressor, whose weights go below zero, with so many mm RMS of noise, as joints that training found
would have. Regressors are fitted as training does, to the vertices that a joint or its parent
moves, and held against 200 new people without noise.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import time

import numpy as np
from common import machine, parser, write_json
from rich.console import Console
from rich.table import Table

from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import body_template
from habitus.learn.shape.joint_regressor import fit_joint_regressor

NEW = 200
SHOWN = (
    "spine1",
    "spine2",
    "spine3",
    "neck",
    "left_hip",
    "left_collar",
    "left_shoulder",
    "left_knee",
)


def main() -> None:
    """Run and write."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--people", type=int, nargs="+", default=[20, 40])
    arguments.add_argument("--noise", type=float, default=5.0, help="mm")
    options = arguments.parse_args()
    body = load_body("default")
    rng = np.random.default_rng(0)
    template = body_template(body)
    moved = body.skinning_weights.T > 0
    near = np.stack([moved[j] | moved[max(parent, 0)] for j, parent in enumerate(body.parents)])
    new = rng.standard_normal((NEW, body.num_betas))
    surfaces = body.rest_vertices(new)
    joints = body.rest_joints(new)
    table = Table(
        title=f"joints of {NEW} new people, mean error in mm; {options.noise:g} mm noise in "
        "training"
    )
    for heading in ("people", "regressor", *SHOWN, "all", "signed rows", "s"):
        table.add_column(heading)
    results = []
    for count in options.people:
        people = rng.standard_normal((count, body.num_betas))
        noisy = body.rest_joints(people)
        noisy = noisy + 1e-3 * options.noise / np.sqrt(3) * rng.standard_normal(noisy.shape)
        for signs in ("convex", "auto"):
            mirrors = {"mirror": template.mirror, "joint_mirror": template.joint_mirror}
            begun = time.perf_counter()
            found = fit_joint_regressor(
                body.rest_vertices(people), noisy, signs=signs, candidates=near, **mirrors
            )
            seconds = time.perf_counter() - begun
            errors = 1e3 * np.linalg.norm(found @ surfaces - joints, axis=-1).mean(0)
            of = dict(zip(body.joint_names, errors.tolist(), strict=True))
            signed = int((found.min(1) < 0).sum())
            numbers = [f"{of[name]:.1f}" for name in SHOWN]
            table.add_row(
                str(count), signs, *numbers, f"{errors.mean():.2f}", str(signed), f"{seconds:.0f}"
            )
            results.append(
                {
                    "people": count,
                    "signs": signs,
                    "mm": of,
                    "signed_rows": signed,
                    "seconds": seconds,
                }
            )
    Console(width=150).print(table)
    write_json(options.out, {"machine": machine(), "noise_mm": options.noise, "results": results})


if __name__ == "__main__":
    main()
