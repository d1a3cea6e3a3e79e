"""A synthetic capture of a known body, fitted with the ordinary command: what was recovered against
what is true.

python examples/demo.py [--out demo_out] [--frames 600] [--seed 1]
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import shipped_prior
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.observe.simulated_markers import (
    Faults,
    SyntheticCapture,
    simulate_capture,
    smooth_motion,
)

RATE_HZ = 120.0
SWAPPED = ("LWRA", "LWRB")


def make_capture(
    body: BodyModel, frames: int, seed: int
) -> tuple[SyntheticCapture, tuple[str, ...]]:
    """A moving body with all markers of the MoSh 67 layout and its extras: placement errors (1 cm),
    noise (1 mm), gaps.

    Gaps take 3 % of the samples, and a pair is swapped for a third of the time.
    """
    rng = np.random.default_rng(seed)
    layout = load_layout("mosh-67")
    prior = shipped_prior().for_joints(body.joint_names)
    betas = np.clip(rng.normal(scale=1.0, size=body.num_betas), -2, 2)
    pose, trans = smooth_motion(
        prior.mean, np.sqrt(np.diag(prior.covariance)), frames, RATE_HZ, rng
    )
    pair = tuple(layout.labels.index(label) for label in SWAPPED)
    faults = Faults(swapped=(*pair, frames // 3, 2 * frames // 3))
    capture = simulate_capture(
        body, betas, pose, trans, layout.vertices(body), layout.distances(), faults, rng
    )
    return capture, layout.labels


def compare(
    body: BodyModel, truth: SyntheticCapture, labels: tuple[str, ...], folder: Path
) -> dict[str, float | bool]:
    """Recovered against true, in millimetres: posed surface, shape alone, latent markers; and was
    the swap found.
    """
    with np.load(folder / "body.npz") as found:
        betas = found["betas"]
        latent = found["markers_latent"]
        names = [str(x) for x in found["latent_labels"]]
        pose = found["poses"].reshape(len(found["poses"]), -1, 3)
        trans = found["trans"]
        soft = found["soft_tissue_betas"]
    every = slice(None, None, 10)
    true = body(truth.betas, truth.pose[every], truth.trans[every]).vertices
    ours = body(betas, pose[every], trans[every], soft_tissue=soft[every]).vertices
    shape = body.rest_vertices(np.stack([truth.betas, betas]))
    suspects = json.loads((folder / "metrics.json").read_text())["suspect_markers"]
    order = [names.index(label) for label in labels]
    return {
        "posed surface": 1e3 * float(np.linalg.norm(true - ours, axis=-1).mean()),
        "rest shape": 1e3 * float(np.linalg.norm(shape[0] - shape[1], axis=-1).mean()),
        "latent markers": 1e3
        * float(np.linalg.norm(latent[order] - truth.latent_markers, axis=1).mean()),
        "swap found": {x["label"] for x in suspects if "swapped" in x["reason"]} == set(SWAPPED),
    }


def main() -> None:
    """Make, fit, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("demo_out"))
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    body = load_body("default")
    truth, labels = make_capture(body, options.frames, options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "demo.c3d"
    write_c3d(Capture("demo", labels, truth.observed, RATE_HZ, "+y"), file)
    print(
        f"wrote {file}: {options.frames} frames, {len(labels)} markers, "
        f"{SWAPPED[0]} and {SWAPPED[1]} swapped for a third of them"
    )
    subprocess.run(
        [sys.executable, "-m", "habitus", "mosh", str(file), "--out", str(options.out)], check=True
    )
    print("\nrecovered against true")
    for name, value in compare(body, truth, labels, options.out / "demo").items():
        print(
            f"  {name:15s} {'yes' if value is True else 'no' if value is False else f'{value:.2f} mm'}"
        )
    print(f"\nthe report lies at {options.out / 'demo' / 'report.html'}")


if __name__ == "__main__":
    main()
