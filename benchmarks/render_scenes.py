"""What the renderer's speed is measured on: a lit torus seen at an angle, drawn by `habitus` and
put to work.

    python benchmarks/render_scenes.py [--triangles 13776] [--size 640 480] [--out
    render_scenes.png]

Run by itself it draws the torus, so that one sees what is timed. The torus hides parts of itself,
is lit by nine spherical harmonics, and covers 58 % of the image.
"""

import os

from common import parser

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from random import Random

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.nn.functional import mse_loss

from habitus.mesh.normals import vertex_normals
from habitus.mesh.shapes import torus
from habitus.observe.camera import Camera
from habitus.observe.lighting import spherical_harmonics
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.triangles import Triangles

SIZE = (640, 480)
TRIANGLES = 13_776
FOCAL_LENGTH = 820.0
"""Pixels, for an image of `SIZE`."""
DISTANCE = 4.0
ELEVATION = math.radians(27)
LIGHT = (
    (0.75, 0.72, 0.68),
    (0.35, 0.3, 0.25),
    (0.2, 0.25, 0.3),
    (0.1, 0.0, -0.1),
    *(((0.04, 0.03, 0.02),) * 5),
)


@dataclass(frozen=True, eq=False)
class TorusScene:
    """Everything that an image of the torus follows from, one dtype; all but the triangles can be
    differentiated.

    vertices (V, 3) metres, albedo (V, 3), light (9, 3); the camera's numbers as in `Camera`, whose
    distortion is None where the scene is only looked at.
    """

    size: tuple[int, int]
    triangles: Triangles
    vertices: Tensor
    albedo: Tensor
    light: Tensor
    focal_length: Tensor
    principal_point: Tensor
    rotation: Tensor
    translation: Tensor
    distortion: Tensor | None = None

    @property
    def camera(self) -> Camera:
        """The camera made of the scene's numbers."""
        numbers = (
            self.focal_length,
            self.principal_point,
            self.rotation,
            self.translation,
            self.distortion,
        )
        return Camera(*self.size, *numbers)

    @property
    def colours(self) -> Tensor:
        """Lit colours of the vertices (V, 3)."""
        return self.albedo * spherical_harmonics(
            vertex_normals(self.vertices, self.triangles.faces), self.light
        )

    def draw(self, boundary: str = "antialias", cull: bool = False) -> Frame:
        """What the camera sees."""
        return draw(self.camera, self.vertices, self.triangles, boundary, cull)

    def leaves(self) -> "TorusScene":
        """The same scene, with zero distortion if there was none, as leaves to be differentiated
        with respect to.
        """
        distortion = self.translation.new_zeros(8) if self.distortion is None else self.distortion
        numbers = {
            "distortion": distortion,
            **{name: getattr(self, name) for name in self.numbers()},
        }
        return replace(
            self,
            **{name: value.detach().clone().requires_grad_() for name, value in numbers.items()},
        )

    def numbers(self) -> list[str]:
        """Names of the fields that can be differentiated."""
        return [
            field.name for field in fields(self) if isinstance(getattr(self, field.name), Tensor)
        ]


def torus_scene(
    size: tuple[int, int] = SIZE, triangles: int = TRIANGLES, dtype: torch.dtype = torch.float32
) -> TorusScene:
    """A torus of about that many triangles, as large in the image as its smaller side allows."""
    across = max(3, round(math.sqrt(triangles / 2) * 0.988))
    shape = torus(max(3, round(triangles / 2 / across)), across)
    x, y, z = shape.vertices.T
    albedo = torch.stack(
        [
            0.6 + 0.3 * torch.sin(3 * x + y),
            0.6 + 0.3 * torch.cos(4 * z),
            0.6 + 0.3 * torch.sin(5 * y),
        ],
        1,
    )
    zoom = min(size[0] / SIZE[0], size[1] / SIZE[1])
    numbers = {
        "focal_length": [FOCAL_LENGTH * zoom] * 2,
        "principal_point": [size[0] / 2, size[1] / 2],
        "rotation": [ELEVATION - math.pi, 0.0, 0.0],
        "translation": [0.0, 0.0, DISTANCE],
    }
    return TorusScene(
        size,
        Triangles.of(shape.faces, positions=shape.vertices),
        shape.vertices.to(dtype),
        albedo.to(dtype),
        torch.tensor(LIGHT, dtype=dtype),
        **{name: torch.tensor(value, dtype=dtype) for name, value in numbers.items()},
    )


def moved(scene: TorusScene) -> TorusScene:
    """The scene after a step aside of 2 cm and a turn of 1 degree: what a pixel loss compares
    with.
    """
    step = scene.translation.new_tensor([0.02, -0.01, 0.03])
    turn = scene.rotation.new_tensor([0.017, 0.0, 0.0])
    return replace(scene, translation=scene.translation + step, rotation=scene.rotation + turn)


def forward(
    scene: TorusScene, colours: Tensor, boundary: str = "antialias", cull: bool = False
) -> tuple[Tensor, Tensor]:
    """Colour (H, W, 3) and depth (H, W), without derivatives."""
    with torch.no_grad():
        frame = scene.draw(boundary, cull)
        return frame.image(colours), frame.depth()


def gradient(scene: TorusScene, target: Tensor, boundary: str = "antialias") -> dict[str, Tensor]:
    """Derivatives of the mean squared difference to `target` with respect to every number of a
    scene of leaves.
    """
    loss = mse_loss(scene.draw(boundary).image(scene.colours), target)
    names = scene.numbers()
    return dict(
        zip(names, torch.autograd.grad(loss, [getattr(scene, name) for name in names]), strict=True)
    )


def vertex_gradient(scene: TorusScene, colours: Tensor, target: Tensor) -> np.ndarray:
    """Derivatives (V, 3) of the same loss with respect to vertices alone, their colours held."""
    vertices = scene.vertices.detach().clone().requires_grad_()
    loss = mse_loss(replace(scene, vertices=vertices).draw().image(colours), target)
    return torch.autograd.grad(loss, vertices)[0].numpy()


def take_turns(works: dict[str, Callable], runs: int) -> dict[str, list[float]]:
    """Milliseconds of `runs` calls of each, in a new order each round, after one of each that is
    not counted.

    What one leaves behind (threads that still wind down, a cache full of its own) then hits all
    alike.
    """
    times: dict[str, list[float]] = {name: [] for name in works}
    order = list(works)
    random = Random(0)
    for run in range(runs + 1):
        random.shuffle(order)
        for name in order:
            began = time.perf_counter()
            works[name]()
            if run:
                times[name].append(1e3 * (time.perf_counter() - began))
    return times


def show(title: str, heads: Iterable[str], rows: Iterable[Iterable], caption: str = "") -> None:
    """Print a table: the first column to the left, numbers to the right."""
    table = Table(title=title, caption=caption)
    for k, head in enumerate(heads):
        table.add_column(head, justify="right" if k else "left")
    for row in rows:
        table.add_row(*(f"{cell:,.3g}" if isinstance(cell, float) else str(cell) for cell in row))
    Console(width=130).print(table)


def save_picture(image: np.ndarray, path: Path) -> None:
    """Colours from 0 to 1 (H, W, 3) as a PNG."""
    from PIL import Image

    Image.fromarray((np.clip(image, 0.0, 1.0) * 255).round().astype(np.uint8)).save(path)


def main() -> None:
    """Draw the torus."""
    arguments = parser(__doc__)
    arguments.add_argument("--triangles", type=int, default=TRIANGLES)
    arguments.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("WIDTH", "HEIGHT"))
    arguments.add_argument("--out", type=Path, default=Path("render_scenes.png"))
    options = arguments.parse_args()
    scene = torus_scene(tuple(options.size), options.triangles)
    colour, depth = forward(scene, scene.colours)
    save_picture(colour.numpy(), options.out)
    covered = float(depth.isfinite().double().mean())
    print(
        f"{len(scene.triangles.faces):,} triangles cover {covered:.0%} of the image; wrote "
        f"{options.out}"
    )


if __name__ == "__main__":
    main()
