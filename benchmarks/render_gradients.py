"""Are the renderer's derivative images right? Against finite differences of exact pictures, pixel
for pixel.

    python benchmarks/render_gradients.py [--height 480] [--scenes cube sphere body side]
    [--vertices 100]
                                          [--out render_gradients.json]

Scenes (`render_gradient_scenes.py`) change by one number at a time: translation, rotation, focal
length, a light, a vertex. The reference is the central difference of two pictures that share no
code with the renderer: by exact areas (`render_exact.py`, apart by 2e-4 pixels), or, of textures,
ray-cast (`render_gradient_reference.py`) with `--samples`² rays a pixel, apart by twice `--step`
pixels. Five times the step (half the samples a side and twice the step) tells its own error.
Boundary modes are compared with it by the cosine between derivative images and the ratio of their
norms: over the whole picture, and apart over pixels crossed by an outline before the background
("boundary"), by one before another part of the mesh ("occlusion"), by a seam between colours
("seam"), and the rest ("interior").

Then single vertices and single triangles: random ones that show, each moved in a random direction
in space, shading and all. How many keep within cosine .99 and 3 % of the norm?
"""

import os

os.environ.setdefault(
    "OMP_WAIT_POLICY", "passive"
)  # libgomp's spinning makes two threads slower at random

import itertools
from dataclasses import replace

import numpy as np
import torch
from common import in_words, machine, parser, write_json
from render_gradient_scenes import SCENES, GradientScene, Parameters
from rich.console import Console
from rich.table import Table
from scipy.ndimage import maximum_filter

MODES = ("antialias", "exact", "filter")
PARAMETERS = ("translation", "rotation", "focal", "light", "vertex")
BODIES = ("body", "side")
REGIONS = ("interior", "boundary", "occlusion", "seam")
LEAST_COSINE, MOST_OFF = 0.99, 0.03
"""What a mode has to reach over the whole picture."""
MARGIN = 8
"""Pixels drawn around what a single vertex may change."""


def derivative(scene: GradientScene, direction: Parameters, boundary: str) -> np.ndarray:
    """The renderer's derivative image (H, W, C), by forward mode."""
    zero = {name: torch.zeros_like(value) for name, value in scene.start.items()}
    _, derivative = torch.func.jvp(
        lambda given: scene.draw(given, boundary), (scene.start,), ({**zero, **direction},)
    )
    return derivative.numpy()


def finite_difference(
    scene: GradientScene, direction: Parameters, step: float, samples: int
) -> np.ndarray:
    """The reference (H, W, C). `step`: how far the fastest vertex moves to each side, in pixels;
    where none does 1e-3.

    Two grids of an eighth of the samples go first. Where they differ by 1 % of the strong pixels,
    and around there, all samples are taken: a thin part may slip through both grids, but not in its
    neighbours too.
    """
    speed = _speed(scene, direction)
    size = step / speed if speed > 0 else 1e-3
    plus, minus = (_moved(scene, direction, length) for length in (size, -size))

    def difference(samples: int, only: np.ndarray | None = None) -> np.ndarray:
        return (scene.reference(plus, samples, only) - scene.reference(minus, samples, only)) / (
            2 * size
        )

    if samples < 16:
        return difference(samples)
    rough = difference(samples // 8)
    other = difference(samples // 8 + 1)
    differ = (np.abs(rough - other) > 0.01 * np.quantile(np.abs(rough).max(-1), 0.99)).any(-1)
    around = maximum_filter(differ, 3)
    return np.where(around[..., None], difference(samples, around), other)


def exact_difference(scene: GradientScene, direction: Parameters, step: float = 1e-4) -> np.ndarray:
    """The same (H, W, C) by exact areas, for scenes without a texture."""
    speed = _speed(scene, direction)
    size = step / speed if speed > 0 else 1e-3
    plus, minus = (scene.exact(_moved(scene, direction, length)) for length in (size, -size))
    return (plus - minus) / (2 * size)


def _speed(scene: GradientScene, direction: Parameters) -> float:
    """How fast the fastest vertex moves on the screen, in pixels."""
    apart = scene.screen(_moved(scene, direction, 1e-6)) - scene.screen(scene.start)
    return float(np.linalg.norm(apart[:, :2], axis=1).max() / 1e-6)


def _moved(scene: GradientScene, direction: Parameters, length: float) -> Parameters:
    return {name: value + length * direction.get(name, 0.0) for name, value in scene.start.items()}


def regions(scene: GradientScene) -> dict[str, np.ndarray]:
    """Masks (H, W) that share the picture out among `REGIONS`; of several edges in a pixel,
    occlusions go first.
    """
    frame, _ = scene.frame(scene.start, "antialias")
    fragments = frame.visibility.fragments
    masks = {}
    taken = np.zeros(frame.height * frame.width, bool)
    hidden = fragments.outer_face >= 0
    kinds = {
        "occlusion": ~fragments.seam & hidden,
        "boundary": ~fragments.seam & ~hidden,
        "seam": fragments.seam,
    }
    for name, chosen in kinds.items():
        mask = np.zeros_like(taken)
        mask[fragments.pixel[chosen].numpy()] = True
        masks[name] = mask & ~taken
        taken |= mask
    masks["interior"] = ~taken
    return {name: mask.reshape(frame.height, frame.width) for name, mask in masks.items()}


def compare(
    image: np.ndarray, reference: np.ndarray, masks: dict[str, np.ndarray]
) -> dict[str, dict]:
    """Cosine and norm ratio over the whole and over each mask, and the mask's share of the
    reference's squared norm.
    """
    total = np.linalg.norm(reference)
    found = {}
    for name, mask in {"whole": np.ones(image.shape[:2], bool), **masks}.items():
        a = image[mask].ravel()
        b = reference[mask].ravel()
        long = np.linalg.norm(a)
        norm = np.linalg.norm(b)
        if norm > 1e-6 * total:
            cosine = a @ b / max(long * norm, 1e-300)
            numbers = {"cosine": cosine, "ratio": long / norm, "share": (norm / total) ** 2}
            found[name] = {key: float(number) for key, number in numbers.items()}
    return found


def measure(scene: GradientScene, step: float, samples: int) -> list[dict]:
    """One row for each component of each parameter."""
    masks = regions(scene)
    rows = []
    for name in PARAMETERS:
        for axis, unit in enumerate(torch.eye(len(scene.start[name]), dtype=torch.float64)):
            direction = {name: unit}
            if scene.texture is None:
                reference, other = (
                    exact_difference(scene, direction, size) for size in (1e-4, 5e-4)
                )
            else:
                reference = finite_difference(scene, direction, step, samples)
                other = finite_difference(scene, direction, 2 * step, samples // 2)
            images = {mode: derivative(scene, direction, mode) for mode in MODES}
            found = {
                kind: compare(image, reference, masks)
                for kind, image in {**images, "reference": other}.items()
            }
            rows.append({"scene": scene.name, "parameter": name, "component": axis, **found})
    return rows


def measure_singles(scene: GradientScene, count: int, corners: int) -> list[dict]:
    """One row for each of `count` random places that show: vertices (corners = 1) or triangles (3),
    moved alone.
    """
    random = np.random.default_rng(0)
    rows = []
    screen = scene.screen(scene.start)
    faces = np.asarray(scene.faces)
    for vertex in random.permutation(len(screen)):
        if len(rows) == count:
            break
        if not shows(screen, faces, scene.size, vertex):
            continue
        face = faces[random.choice(np.flatnonzero((faces == vertex).any(1)))]
        moved = np.array([vertex]) if corners == 1 else face
        unit = torch.from_numpy(random.normal(size=3))
        direction = {"vertex": unit / unit.norm()}
        alone = replace(scene, moved=torch.from_numpy(moved)).part(
            *around(screen, faces, scene.size, moved)
        )
        reference = exact_difference(alone, direction)
        found = {
            mode: compare(derivative(alone, direction, mode), reference, {})["whole"]
            for mode in MODES
        }
        rows.append({"scene": scene.name, "corners": corners, "moved": moved.tolist(), **found})
    return rows


def shows(screen: np.ndarray, faces: np.ndarray, size: tuple[int, int], vertex: int) -> bool:
    """Whether a vertex lies in the picture and no triangle but its own is before it."""
    x, y, depth = screen[vertex]
    a, b, c = (screen[faces[:, k]] for k in range(3))

    def side(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return (q[:, 0] - p[:, 0]) * (y - p[:, 1]) - (q[:, 1] - p[:, 1]) * (x - p[:, 0])

    shares = np.stack([side(b, c), side(c, a), side(a, b)], 1)
    inside = ((shares > 0).all(1) | (shares < 0).all(1)) & ~(faces == vertex).any(1)
    over = shares[inside]
    corners = np.stack([a, b, c], 1)[inside]
    hidden = (over / corners[..., 2]).sum(1) / over.sum(1) > 1 / depth
    return bool(0 < x < size[0] and 0 < y < size[1] and not hidden.any())


def around(
    screen: np.ndarray, faces: np.ndarray, size: tuple[int, int], moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (column, row) between which a picture may change with vertices: `MARGIN` around the
    faces whose normals' vertices they belong to.
    """
    near = np.unique(faces[np.isin(faces, moved).any(1)])
    points = screen[np.unique(faces[np.isin(faces, near).any(1)]), :2]
    low = np.floor(points.min(0)).astype(int) - MARGIN
    high = np.ceil(points.max(0)).astype(int) + MARGIN
    return low.clip(0), high.clip(None, size)


def singles_table(rows: list[dict], title: str) -> Table:
    """For each scene, kind and mode: how many hold, and quantiles of cosines and norm ratios."""
    heads = (
        "scene",
        "alone",
        "mode",
        "hold",
        "cosine: least",
        "5 %",
        "10 %",
        "median",
        "ratio: 5 %",
        "median",
        "95 %",
    )
    result = Table(*heads, title=title)
    for (scene, corners), group in itertools.groupby(
        rows, lambda row: (row["scene"], row["corners"])
    ):
        found = list(group)
        for mode in MODES:
            cosine, ratio = (
                np.array([row[mode][key] for row in found]) for key in ("cosine", "ratio")
            )
            hold = np.mean([not misses(row[mode]) for row in found])
            numbers = [
                *np.quantile(cosine, [0, 0.05, 0.1, 0.5]),
                *np.quantile(ratio, [0.05, 0.5, 0.95]),
            ]
            kind = f"{len(found)} {'vertices' if corners == 1 else 'triangles'}"
            result.add_row(
                scene, kind, mode, f"{hold:.0%}", *(f"{number:.4f}" for number in numbers)
            )
    return result


def misses(whole: dict) -> bool:
    """Whether a derivative image misses what is asked of it."""
    return whole["cosine"] < LEAST_COSINE or abs(whole["ratio"] - 1) > MOST_OFF


def table(rows: list[dict], title: str) -> Table:
    """The worst component of each parameter, cosine and norm ratio, with its share of the squared
    norm in brackets.
    """
    result = Table(
        "scene", "d", "reference", *(f"{mode}: whole" for mode in MODES), *REGIONS, title=title
    )
    for (scene, parameter), group in itertools.groupby(
        rows, lambda row: (row["scene"], row["parameter"])
    ):
        worst = min(
            group, key=lambda row: row["antialias"]["whole"]["cosine"]
        )  # the default mode's
        whole = (_words(worst[kind].get("whole")) for kind in ("reference", *MODES))
        apart = (_words(worst["antialias"].get(region), share=True) for region in REGIONS)
        result.add_row(scene, f"{parameter} {worst['component']}", *whole, *apart)
    return result


def _words(found: dict | None, share: bool = False) -> str:
    if found is None:
        return ""
    return f"{found['cosine']:.4f} {found['ratio']:.3f}" + (
        f" ({100 * found['share']:.0f} %)" if share else ""
    )


def main() -> None:
    """Measure, write JSON, print a table."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument(
        "--height", type=int, default=480, help="of the pictures, in pixels; they are 4/3 as wide"
    )
    arguments.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    arguments.add_argument(
        "--step",
        type=float,
        default=0.02,
        help="of the fastest vertex in finite differences, pixels",
    )
    arguments.add_argument("--samples", type=int, default=256, help="rays a pixel along each axis")
    arguments.add_argument(
        "--vertices", type=int, default=100, help="single ones, and triangles, of bodies; or 0"
    )
    options = arguments.parse_args()
    host = machine()
    rows = []
    singles = []
    settings = {"height": options.height, "step": options.step, "samples": options.samples}
    for name in options.scenes:
        scene = SCENES[name](options.height)
        rows += measure(scene, options.step, options.samples)
        for corners in (1, 3) if name in BODIES and options.vertices else ():
            singles += measure_singles(scene, options.vertices, corners)
        write_json(
            options.out, {"machine": host, "settings": settings, "rows": rows, "singles": singles}
        )
    console = Console(width=190)
    console.print(table(rows, f"derivative images, {options.height} lines: {in_words(host)}"))
    console.print(singles_table(singles, f"single vertices and triangles, {options.height} lines"))
    for mode in MODES:
        short = [
            f"{row['scene']} {row['parameter']} {row['component']}"
            for row in rows
            if misses(row[mode]["whole"])
        ]
        words = f"{', '.join(short) or 'none'} of {len(rows)}"
        print(f"{mode}: short of cosine {LEAST_COSINE} and {MOST_OFF:.0%} of the norm: {words}")


if __name__ == "__main__":
    main()
