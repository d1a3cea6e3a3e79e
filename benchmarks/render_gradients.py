"""Are the renderer's derivative images right? Against finite differences of pictures by brute force, pixel for pixel.

    python benchmarks/render_gradients.py [--height 480] [--scenes cube sphere body] [--out render_gradients.json]

Three scenes (`render_gradient_scenes.py`) change by one number at a time: translation, rotation, focal length, a light,
a vertex. The reference is the central difference of two ray-cast pictures (`render_gradient_reference.py`) with
`--samples`² rays a pixel, apart by twice the step that moves the fastest vertex by `--step` pixels; half the samples a
side and twice the step tell its own error. Both boundary modes are compared with it by the cosine between derivative
images and the ratio of their norms: over the whole picture, and apart over pixels crossed by an outline before the
background ("boundary"), by one before another part of the mesh ("occlusion"), by a seam between colours ("seam"), and
the rest ("interior"). Two busy cores take about an hour in all.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # libgomp's spinning makes two threads slower at random

import argparse
import itertools
from pathlib import Path

import numpy as np
import torch
from common import in_words, machine, write_json
from render_gradient_scenes import SCENES, GradientScene, Parameters
from rich.console import Console
from rich.table import Table
from scipy.ndimage import maximum_filter

MODES = ("antialias", "filter")
PARAMETERS = ("translation", "rotation", "focal", "light", "vertex")
REGIONS = ("interior", "boundary", "occlusion", "seam")
LEAST_COSINE, MOST_OFF = 0.99, 0.03
"""What the default mode has to reach over the whole picture."""


def derivative(scene: GradientScene, direction: Parameters, boundary: str) -> np.ndarray:
    """The renderer's derivative image (H, W, C), by forward mode."""
    zero = {name: torch.zeros_like(value) for name, value in scene.start.items()}
    _, derivative = torch.func.jvp(lambda given: scene.draw(given, boundary), (scene.start,), ({**zero, **direction},))
    return derivative.numpy()


def finite_difference(scene: GradientScene, direction: Parameters, step: float, samples: int) -> np.ndarray:
    """The reference (H, W, C). `step`: how far the fastest vertex moves to each side, in pixels; where none does 1e-3.

    Two grids of an eighth of the samples go first. Where they differ by 1 % of the strong pixels, and around there, all
    samples are taken: a thin part may slip through both grids, but not in its neighbours too.
    """
    speed = np.linalg.norm(scene.screen(_moved(scene, direction, 1e-6)) - scene.screen(scene.start), axis=1).max()
    size = step / (speed / 1e-6) if speed > 0 else 1e-3
    plus, minus = (_moved(scene, direction, length) for length in (size, -size))

    def difference(samples: int, only: np.ndarray | None = None) -> np.ndarray:
        return (scene.reference(plus, samples, only) - scene.reference(minus, samples, only)) / (2 * size)

    if samples < 16:
        return difference(samples)
    rough, other = difference(samples // 8), difference(samples // 8 + 1)
    differ = (np.abs(rough - other) > 0.01 * np.quantile(np.abs(rough).max(-1), 0.99)).any(-1)
    around = maximum_filter(differ, 3)
    return np.where(around[..., None], difference(samples, around), other)


def _moved(scene: GradientScene, direction: Parameters, length: float) -> Parameters:
    return {name: value + length * direction.get(name, 0.0) for name, value in scene.start.items()}


def regions(scene: GradientScene) -> dict[str, np.ndarray]:
    """Masks (H, W) that share the picture out among `REGIONS`; of several edges in a pixel, occlusions go first."""
    frame, _ = scene.frame(scene.start, "antialias")
    fragments, masks = frame.visibility.fragments, {}
    taken = np.zeros(frame.height * frame.width, bool)
    hidden = fragments.outer_face >= 0
    kinds = {"occlusion": ~fragments.seam & hidden, "boundary": ~fragments.seam & ~hidden, "seam": fragments.seam}
    for name, chosen in kinds.items():
        mask = np.zeros_like(taken)
        mask[fragments.pixel[chosen].numpy()] = True
        masks[name] = mask & ~taken
        taken |= mask
    masks["interior"] = ~taken
    return {name: mask.reshape(frame.height, frame.width) for name, mask in masks.items()}


def compare(image: np.ndarray, reference: np.ndarray, masks: dict[str, np.ndarray]) -> dict[str, dict]:
    """Cosine and norm ratio over the whole and over each mask, and the mask's share of the reference's squared norm."""
    total, found = np.linalg.norm(reference), {}
    for name, mask in {"whole": np.ones(image.shape[:2], bool), **masks}.items():
        a, b = image[mask].ravel(), reference[mask].ravel()
        long, norm = np.linalg.norm(a), np.linalg.norm(b)
        if norm > 1e-6 * total:
            cosine = a @ b / max(long * norm, 1e-300)
            numbers = {"cosine": cosine, "ratio": long / norm, "share": (norm / total) ** 2}
            found[name] = {key: float(number) for key, number in numbers.items()}
    return found


def measure(scene: GradientScene, step: float, samples: int) -> list[dict]:
    """One row for each component of each parameter."""
    masks, rows = regions(scene), []
    for name in PARAMETERS:
        for axis, unit in enumerate(torch.eye(len(scene.start[name]), dtype=torch.float64)):
            reference = finite_difference(scene, {name: unit}, step, samples)
            images = {mode: derivative(scene, {name: unit}, mode) for mode in MODES}
            images["reference"] = finite_difference(scene, {name: unit}, 2 * step, samples // 2)
            found = {kind: compare(image, reference, masks) for kind, image in images.items()}
            rows.append({"scene": scene.name, "parameter": name, "component": axis, **found})
    return rows


def falls_short(row: dict) -> bool:
    """Whether the default mode misses what is asked of it over the whole picture."""
    whole = row["antialias"]["whole"]
    return whole["cosine"] < LEAST_COSINE or abs(whole["ratio"] - 1) > MOST_OFF


def table(rows: list[dict], title: str) -> Table:
    """The worst component of each parameter, cosine and norm ratio, with its share of the squared norm in brackets."""
    result = Table("scene", "d", "reference", *(f"{mode}: whole" for mode in MODES), *REGIONS, title=title)
    for (scene, parameter), group in itertools.groupby(rows, lambda row: (row["scene"], row["parameter"])):
        worst = min(group, key=lambda row: row["antialias"]["whole"]["cosine"])
        whole = (_words(worst[kind].get("whole")) for kind in ("reference", *MODES))
        apart = (_words(worst["antialias"].get(region), share=True) for region in REGIONS)
        result.add_row(scene, f"{parameter} {worst['component']}", *whole, *apart)
    return result


def _words(found: dict | None, share: bool = False) -> str:
    if found is None:
        return ""
    return f"{found['cosine']:.4f} {found['ratio']:.3f}" + (f" ({100 * found['share']:.0f} %)" if share else "")


def main() -> None:
    """Measure, write JSON, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=480, help="of the pictures, in pixels; they are 4/3 as wide")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--step", type=float, default=0.02, help="of the fastest vertex in finite differences, pixels")
    parser.add_argument("--samples", type=int, default=256, help="rays a pixel along each axis")
    parser.add_argument("--out", type=Path, default=Path("render_gradients.json"))
    options = parser.parse_args()
    host, rows = machine(), []
    for name in options.scenes:
        rows += measure(SCENES[name](options.height), options.step, options.samples)
    settings = {"height": options.height, "step": options.step, "samples": options.samples}
    short = [f"{row['scene']} {row['parameter']} {row['component']}" for row in rows if falls_short(row)]
    write_json(options.out, {"machine": host, "settings": settings, "rows": rows, "falls_short": short})
    Console(width=170).print(table(rows, f"derivative images, {options.height} lines: {in_words(host)}"))
    print(f"short of cosine {LEAST_COSINE} and {MOST_OFF:.0%} of the norm: {', '.join(short) or 'none'} of {len(rows)}")


if __name__ == "__main__":
    main()
