"""Does the globe of `examples/globe.py` find back from 30 degrees and a quarter of its diameter
off?

    python benchmarks/render_recovery.py [--starts 20] [--out render_recovery.json]

Each start has a globe of its own: turned at random, four metres away, in a random light. The fit
begins exactly 30 degrees off about a random axis and half a metre off in a random direction, under
plain light, and looks for 15 numbers. What counts is where it ends: within 0.1 degree, and within
0.1 % of its distance. The recipe is the example's: five iterations of the translation alone, ten of
everything on small pictures, then (these are counted) on all. Beside it the last stage alone, and
noise in the picture. Nothing is tried twice.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import math
import sys
import time
from statistics import median

import numpy as np
import torch
from common import ROOT, in_words, machine, parser, write_json
from render_scenes import show
from torch import Tensor

sys.path.insert(0, str(ROOT / "examples"))
import globe

from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

TURN = math.radians(30)
OFFSET = 0.5
DISTANCE = 4.0
DEGREES, PERCENT = 0.1, 0.1
"""Targets: of the rotation, and of the translation as a share of the distance."""
RECIPES = {
    "dogleg": {},
    "Levenberg-Marquardt": {"method": "levenberg"},
    "L-BFGS": {"method": "lbfgs"},
    "dogleg, last stage alone": {"stages": False},
    "dogleg, noise of 1 %": {"noise": 0.01},
}


def case(seed: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """A globe, and where the fit begins."""
    random = np.random.default_rng(seed)

    def direction() -> Tensor:
        vector = random.normal(size=3)
        return torch.tensor(vector / np.linalg.norm(vector))

    rotation = direction() * random.uniform(0, math.pi)
    light = torch.tensor([1.0, *random.normal(scale=0.2, size=8)])
    truth = {"translation": torch.zeros(3).double(), "rotation": rotation, "light": light.double()}
    turned = matrix_from_rotvec(TURN * direction()) @ matrix_from_rotvec(rotation)
    plain = torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0, 0]).double()
    return truth, {
        "translation": OFFSET * direction(),
        "rotation": rotvec_from_matrix(turned),
        "light": plain,
    }


def recover(seed: int, noise: float = 0.0, **recipe) -> dict:
    """One fit, and how far off it ends."""
    truth, start = case(seed)
    observed = globe.render(**truth)
    observed = (
        observed
        + noise
        * torch.randn(observed.shape, generator=torch.Generator().manual_seed(seed)).double()
    )
    began = time.perf_counter()
    found = globe.recover(observed, start, **recipe)
    seconds = time.perf_counter() - began
    metres, degrees = globe.errors(found.values, truth)
    light = float((found.values["light"] - truth["light"]).abs().max())
    percent = 100 * metres / DISTANCE
    reached = degrees <= DEGREES and percent <= PERCENT
    off = {"degrees": degrees, "percent": percent, "light": light, "reached": reached}
    return {
        "seed": seed,
        **off,
        "iterations": found.iterations,
        "seconds": seconds,
        "status": found.status,
    }


def summary(name: str, rows: list[dict]) -> tuple:
    """A recipe's row of the table."""
    columns = {
        key: [row[key] for row in rows] for key in ("degrees", "percent", "iterations", "seconds")
    }
    ends = [
        cell for key in ("degrees", "percent") for cell in (median(columns[key]), max(columns[key]))
    ]
    reached = f"{sum(row['reached'] for row in rows)} of {len(rows)}"
    return (
        name,
        reached,
        *ends,
        round(median(columns["iterations"])),
        round(median(columns["seconds"]), 1),
    )


def main() -> None:
    """Fit every globe with every recipe, and say where each fit ended."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--starts", type=int, default=20)
    options = arguments.parse_args()
    where = machine()
    results = {}
    for name, recipe in RECIPES.items():
        results[name] = [recover(seed, **recipe) for seed in range(options.starts)]
        for row in results[name]:
            if not row["reached"]:
                print(
                    f"{name}: start {row['seed']} ends {row['degrees']:.3g} degrees, "
                    f"{row['percent']:.3g} % off"
                )
    heads = (
        "",
        "reached",
        "degrees off",
        "worst",
        "% of distance off",
        "worst",
        "iterations",
        "seconds",
    )
    caption = f"reached: {DEGREES} degrees and {PERCENT} % of the distance; otherwise medians"
    show(f"globe: {in_words(where)}", heads, [summary(*each) for each in results.items()], caption)
    write_json(
        options.out,
        {"machine": where, "targets": {"degrees": DEGREES, "percent": PERCENT}, "fits": results},
    )


if __name__ == "__main__":
    main()
