"""A soft and a muscular person land from the same jump: a strip of moments, and moving meshes.

    habitus mosh DJ2.trc --out results
    python -m habitus_lab.default_body.landing results/DJ2/body.npz [--body female|FILE] [--moments 3.0 3.1 ...]
        [--out docs/images/dynamics-landing.jpg] [--glb FOLDER]

The people are the stoutest and the leanest but for some of those that `flesh/run.py` poses. Skin is
red where soft tissue has moved outward from where the pose alone has it, blue where inward. `--glb`
writes FOLDER/soft.glb and FOLDER/muscular.glb: the whole motion with soft tissue as morphs.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import habitus
from habitus.body.model import BodyModel
from habitus.jobs.results import load_fit
from habitus_lab.default_body.flesh.people import people
from habitus_lab.default_body.sheet import SKIN, View, _normals, grid
from habitus_lab.repository import REPOSITORY

BUILDS = {"soft": 0.95, "muscular": 0.1}  # share of people who are leaner
OUT = np.array([0.85, 0.25, 0.20])
IN = np.array([0.20, 0.40, 0.85])
FULL = 0.012  # colours at so many metres
HEIGHT = 1.95
WIDTH = 190
ROWS = 330  # m, pixels


def builds(body: BodyModel, sex: str) -> dict[str, np.ndarray]:
    """Betas of the people."""
    some = people(body, sex, 20, 0)
    lean = sorted(
        (shape for shape in some[1:] if shape.age is None), key=lambda shape: shape.stoutness
    )
    return {name: lean[round(rank * (len(lean) - 1))].betas for name, rank in BUILDS.items()}


def strip(
    body: BodyModel, fit, betas: np.ndarray, moments: list[float], yaw: float
) -> list[np.ndarray]:
    """The person at these seconds of the fit's motion."""
    pose = np.asarray(fit.pose)
    trans = np.asarray(fit.trans)
    rate = fit.rate_hz
    delta = np.asarray(habitus.simulate_soft_tissue(body, betas, pose, trans, rate))
    found = []
    for second in moments:
        t = round(second * rate)
        still = body(betas, pose[t], trans[t]).vertices
        moved = body(betas, pose[t], trans[t], dynamics=delta[t]).vertices
        outward = ((moved - still) * _normals(still, body.faces)).sum(1) / FULL
        share = np.clip(np.abs(outward), 0, 1)[:, None]
        colours = (1 - share) * np.array(SKIN) + share * np.where(outward[:, None] > 0, OUT, IN)
        centre = 0.5 * (still.min(0) + still.max(0))
        found.append(View(yaw, 3, centre, HEIGHT, WIDTH, ROWS).picture(moved, body.faces, colours))
    return found


def main() -> None:
    """Draw, and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "fit", type=Path, help="body.npz of a jump that was fitted to the default body"
    )
    parser.add_argument("--body", default="female", help="with dynamics")
    parser.add_argument("--sex", choices=("female", "male"), default="female", help="whose people")
    parser.add_argument(
        "--moments", type=float, nargs="+", default=[3.0, 3.1, 3.2, 3.3, 3.4, 3.5], help="seconds"
    )
    parser.add_argument("--yaw", type=float, default=50)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs/images/dynamics-landing.jpg")
    parser.add_argument("--glb", type=Path)
    options = parser.parse_args()
    fit = load_fit(options.fit)
    upright = habitus.load_body(options.sex, detail="full", joints="smplx")
    full = habitus.load_body(options.body, detail="full", joints="smpl")
    coarse = habitus.load_body(options.body, joints="smpl")
    pictures = []
    for name, betas in builds(upright, options.sex).items():
        pictures += strip(full, fit, betas, options.moments, options.yaw)
        if options.glb is not None:
            options.glb.mkdir(parents=True, exist_ok=True)
            replace(fit, body=coarse, betas=betas).with_dynamics().export(
                options.glb / f"{name}.glb"
            )
    grid(pictures, len(options.moments)).save(options.out, quality=88, optimize=True)
    print(f"wrote {options.out}: {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
