"""Draws the derivative images that `render_gradients.py` measures, and the thesis' Fig 4-7, for
docs/gallery.md.

python benchmarks/render_gradient_pictures.py [--out docs/images]
"""

import os

from common import parser

os.environ.setdefault(
    "OMP_WAIT_POLICY", "passive"
)  # libgomp's spinning makes two threads slower at random

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from render_gradient_scenes import SCENES, GradientScene, quadrilateral_scene
from render_gradients import derivative, finite_difference

SHOWN = {"translation": 0, "rotation": 2, "focal": 0, "light": 0, "vertex": 0}
"""The component of each parameter whose derivative image is drawn."""


def derivative_row(scene: GradientScene) -> list[np.ndarray]:
    """The scene and its derivative images in the default mode (thesis Fig 1-5), cut to the square
    in the middle.
    """
    panels = [scene.draw(scene.start, "antialias").numpy()]
    for name, axis in SHOWN.items():
        unit = torch.eye(len(scene.start[name]), dtype=torch.float64)[axis]
        change = derivative(scene, {name: unit}, "antialias").mean(-1)
        panels.append(red_and_blue(change, np.abs(change).max()))
    return [*(middle(panel) for panel in panels[:-1]), close_up(panels[-1], least=24)]


def turning_quadrilateral(height: int = 48) -> list[list[np.ndarray]]:
    """Thesis Fig 4-7: a quadrilateral, the predicted change as it turns in the plane, finite
    differences.

    The upper row: pixels sampled at centres; the image filter's prediction; finite differences with
    a step of half a pixel at the corners. The lower row: the antialiased picture, its derivative,
    and the reference of the benchmark.
    """
    scene = quadrilateral_scene(height)
    turn = {"rotation": torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)}
    rows = []
    for mode, step, samples in (("filter", 0.5, 1), ("antialias", 0.02, 256)):
        changes = derivative(scene, turn, mode), finite_difference(scene, turn, step, samples)
        rows.append(
            (scene.draw(scene.start, mode).numpy(), *(change.mean(-1) for change in changes))
        )
    most = np.abs(rows[1][2]).max()
    return [
        [picture, *(red_and_blue(change, most) for change in changes)] for picture, *changes in rows
    ]


def red_and_blue(change: np.ndarray, most: float) -> np.ndarray:
    """Red for `most`, white for 0, blue for -`most`, as (H, W, 3); by square roots, so that faint
    changes are seen.
    """
    strength = np.sqrt(np.abs(change).clip(max=most) / most)
    up = strength * (change > 0)
    down = strength * (change < 0)
    return np.stack([1 - down, 1 - up - down, 1 - up], -1)


def middle(panel: np.ndarray) -> np.ndarray:
    """The square in the middle."""
    height, width = panel.shape[:2]
    return panel[:, (width - height) // 2 :][:, :height]


def close_up(panel: np.ndarray, least: int) -> np.ndarray:
    """The square around what is not white, at least so many pixels, each enlarged, as high as the
    panel.
    """
    height, width = panel.shape[:2]
    places = np.argwhere((panel < 0.9).any(-1))
    low = places.min(0)
    high = places.max(0) + 1
    times = max(1, height // max(least, *(high - low + 4)))
    size = height // times
    top, left = np.clip((low + high - size) // 2, 0, (height - size, width - size))
    large = enlarged(panel[top : top + size, left : left + size], times)
    rest = height - len(large)
    return np.pad(large, ((0, rest), (0, rest), (0, 0)), constant_values=1.0)


def enlarged(image: np.ndarray, times: int) -> np.ndarray:
    """Each pixel as a square."""
    return image.repeat(times, 0).repeat(times, 1)


def write(path: Path, rows: list[list[np.ndarray]], gutter: int = 4) -> None:
    """One picture of rows of pictures, with white between them."""
    space = ((gutter, gutter), (gutter, gutter), (0, 0))
    whole = np.concatenate(
        [np.concatenate([np.pad(x, space, constant_values=1.0) for x in row], 1) for row in rows]
    )
    Image.fromarray((255 * whole.clip(0, 1)).round().astype(np.uint8)).save(path, optimize=True)
    print(f"wrote {path}: {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Write both pictures."""
    arguments = parser(__doc__)
    arguments.add_argument("--out", type=Path, default=Path("docs/images"))
    out = arguments.parse_args().out
    write(out / "render-derivatives.png", [derivative_row(scene(144)) for scene in SCENES.values()])
    rows = turning_quadrilateral()
    write(out / "render-fig-4-7.png", [[enlarged(panel, 6) for panel in row] for row in rows])


if __name__ == "__main__":
    main()
