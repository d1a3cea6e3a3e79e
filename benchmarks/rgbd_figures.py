"""The thesis' figures 4-8 and 4-9 with our numbers and people: bars of RMSE and explained variance,
and fits.

python benchmarks/rgbd_figures.py --rows rgbd_people.json --people people.npz --out docs/images
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib
from common import parser

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from rgbd_people import MEASURES

from habitus.io.models.bodies import load_body
from habitus.jobs.rgbd import fit_rgbd
from habitus.report.rgbd import view_pictures
from habitus_lab.population.rgbd_people import rgbd_scene

SHOWN = (
    "Depth observed",
    "Depth of the body",
    "Depth observed less the body's",
    "Colour observed",
    "Rendered",
    "Albedo",
    "Light",
)
NAMES = {
    name: name.removesuffix("_m").replace("_circumference", "").replace("_", " ")
    for name in MEASURES
}


def main() -> None:
    """Both figures."""
    options = _options()
    rows = [row for row in json.loads(options.rows.read_text())["rows"] if row["case"] == "full"]
    rows = [row for row in rows if row["sensor"] == rows[0]["sensor"]]
    _bars(rows, options.out / "rgbd-accuracy.png")
    if options.people is not None:
        _people(options, options.out / "rgbd-people.png")


def _bars(rows: list[dict[str, Any]], path: Path) -> None:
    """Fig 4-8: depth views, a registered scan, and guessing the mean."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    place = np.arange(len(MEASURES))
    true = {name: np.array([row["true"][name] for row in rows]) for name in MEASURES}
    guesses = {
        "guess the mean": {name: np.full(len(rows), true[name].mean()) for name in MEASURES},
        f"depth views ({rows[0]['sensor']})": {
            n: np.array([r["measured"][n] for r in rows]) for n in MEASURES
        },
        "registered scan": {n: np.array([r["registered"][n] for r in rows]) for n in MEASURES},
    }
    for k, (label, found) in enumerate(guesses.items()):
        colour = ("#b9c2ca", "#0b6e7f", "#e67700")[k]
        aside = 0.27 * (k - 1)
        error = np.array([np.mean((found[name] - true[name]) ** 2) for name in MEASURES])
        variance = np.array([true[name].var() for name in MEASURES])
        left.bar(place + aside, 100 * np.sqrt(error), 0.25, color=colour, label=label)
        if k:
            right.bar(place + aside, 100 * (1 - error / variance), 0.25, color=colour)
    for axis, title in ((left, "RMSE (cm)"), (right, "explained variance (%)")):
        axis.set_xticks(place, list(NAMES.values()))
        axis.set_title(title, fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    left.set_yscale("log")
    right.set_ylim(70, 100)
    left.legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def _people(options: argparse.Namespace, path: Path) -> None:
    """Fig 4-9: what was seen and what was found of some people, a view each."""
    body = load_body("default")
    with np.load(options.people) as file:
        rests = file["vertices"].astype(float)
    figure, axes = plt.subplots(
        len(options.which), len(SHOWN), figsize=(11, 3.2 * len(options.which))
    )
    for line, k in zip(np.atleast_2d(axes), options.which, strict=True):
        rng = np.random.default_rng([0, k, 17])
        scene = rgbd_scene(body, rests[k], rng, arms=(45.0, 45.0, 10.0)[k % 3])
        fit = fit_rgbd(scene.capture)
        pictures = view_pictures(fit)[k % 2].pictures
        for axis, name in zip(line, SHOWN, strict=True):
            axis.imshow(pictures[name])
            axis.axis("off")
            axis.set_title(name.replace(" less the body's", "\nless the body's"), fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def _options() -> argparse.Namespace:
    arguments = parser(__doc__)
    arguments.add_argument("--rows", type=Path, required=True, help="JSON of rgbd_people.py")
    arguments.add_argument("--people", type=Path, help="people.npz, for the second figure")
    arguments.add_argument("--which", type=int, nargs="+", default=[3, 12, 20])
    arguments.add_argument("--out", type=Path, default=Path("docs/images"))
    return arguments.parse_args()


if __name__ == "__main__":
    main()
