"""Derivative images against finite differences of supersampled pictures that share nothing with the
renderer.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from habitus.mesh.shapes import cube, torus
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec

WIDTH = 40
HEIGHT = 30
FOCAL = 45.0
BACKGROUND = 0.1
SAMPLES, STEP = 32, 0.06
"""Samples a pixel along each axis, and by how many pixels the fastest vertex moves to each side."""


@dataclass(frozen=True, eq=False)
class Scene:
    vertices: Tensor
    faces: Tensor
    colours: Tensor
    moved: Tensor  # 1 for the vertices, at one place, that "vertex" moves
    rotation: tuple
    translation: tuple

    def start(self) -> dict[str, Tensor]:
        parts = {
            "rotation": self.rotation,
            "translation": self.translation,
            "focal": (FOCAL,),
            "vertex": (0, 0, 0),
        }
        return {name: torch.tensor(value, dtype=torch.float64) for name, value in parts.items()}


def scene(name: str) -> Scene:
    if name == "cube with a colour a side":
        shape = cube()
        tint = torch.tensor([1.0, 0.6, 0.3]).double()
        colours = torch.linspace(0.15, 0.95, 6).double().repeat_interleave(4)[:, None] * tint
        moved = (shape.vertices == 0.5).all(1)
        return Scene(
            shape.vertices,
            shape.faces,
            colours,
            moved[:, None],
            (-2.5, -0.41, 0.83),
            (0.03, -0.02, 2.3),
        )
    shape = torus(12, 8)
    colours = 0.5 + 0.3 * torch.sin(3.0 * shape.vertices + torch.tensor([0.0, 1.0, 2.0]).double())
    moved = torch.arange(len(shape.vertices)) == 2  # drawn farthest to the right
    return Scene(
        shape.vertices, shape.faces, colours, moved[:, None], (2.2, 0.25, 0.35), (0.04, 0.02, 4.1)
    )


def drawn(scene: Scene, given: dict[str, Tensor], boundary: str) -> Tensor:
    pose = {"rotation": given["rotation"], "translation": given["translation"]}
    view = Camera.of(WIDTH, HEIGHT, focal_length=given["focal"].expand(2), **pose)
    vertices = scene.vertices + scene.moved * given["vertex"]
    return draw(view, vertices, Triangles.of(scene.faces, scene.vertices), boundary).image(
        scene.colours, BACKGROUND
    )


def on_the_screen(scene: Scene, given: dict[str, Tensor]) -> tuple[np.ndarray, np.ndarray]:
    points = (scene.vertices + scene.moved * given["vertex"]) @ matrix_from_rotvec(
        given["rotation"]
    ).T
    points = (points + given["translation"]).numpy()
    return points, points[:, :2] / points[:, 2:] * float(given["focal"]) + [WIDTH / 2, HEIGHT / 2]


def supersampled(scene: Scene, given: dict[str, Tensor]) -> np.ndarray:
    """The picture (H, W, 3): means over rays of what they meet first. Rows of rays are shifted, so
    that none align.
    """
    points, screen = on_the_screen(scene, given)
    size = np.array([WIDTH, HEIGHT]) * SAMPLES
    focal = float(given["focal"])
    shift = np.arange(size[1]) * (5**0.5 - 1) / 2 % 1
    nearest = np.zeros(size[::-1])
    picture = np.full((*size[::-1], 3), BACKGROUND)
    for face in scene.faces.numpy():
        low = np.floor(screen[face].min(0) * SAMPLES - 1).astype(int).clip(0)
        high = np.ceil(screen[face].max(0) * SAMPLES).astype(int).clip(0)
        box = np.s_[low[1] : high[1], low[0] : high[0]]
        down = np.arange(size[1])[box[0], None]
        x = ((np.arange(size[0])[box[1]] + shift[down]) / SAMPLES - WIDTH / 2) / focal
        y = ((down + 0.5) / SAMPLES - HEIGHT / 2) / focal
        weights = np.stack([a * x + (b * y + c) for a, b, c in np.linalg.inv(points[face]).T])
        near = weights.sum(0)
        nearer = (weights.min(0) >= 0) & (near > nearest[box])
        nearest[box][nearer] = near[nearer]
        picture[box][nearer] = (weights[:, nearer] / near[nearer]).T @ scene.colours.numpy()[face]
    return picture.reshape(HEIGHT, SAMPLES, WIDTH, SAMPLES, 3).mean((1, 3))


def finite_difference(scene: Scene, direction: dict[str, Tensor]) -> np.ndarray:
    def moved(by: float) -> dict[str, Tensor]:
        return {
            name: value + by * direction.get(name, 0.0) for name, value in scene.start().items()
        }

    ends = [on_the_screen(scene, moved(by))[1] for by in (1e-6, -1e-6)]
    by = STEP * 2e-6 / np.linalg.norm(ends[0] - ends[1], axis=1).max()
    return (supersampled(scene, moved(by)) - supersampled(scene, moved(-by))) / (2 * by)


def agreement(
    scene: Scene, direction: dict[str, Tensor], reference: np.ndarray, boundary: str
) -> tuple[float, float]:
    """Cosine and ratio of norms."""
    start = scene.start()
    tangent = {name: direction.get(name, torch.zeros_like(value)) for name, value in start.items()}
    _, change = torch.func.jvp(lambda given: drawn(scene, given, boundary), (start,), (tangent,))
    image = change.numpy()
    norms = (np.linalg.norm(change.numpy()), np.linalg.norm(reference))
    return float((image * reference).sum() / norms[0] / norms[1]), float(norms[0] / norms[1])


@pytest.mark.parametrize(
    "parameter, axis", [("translation", 0), ("translation", 2), ("rotation", 1), ("vertex", 0)]
)
@pytest.mark.parametrize("name", ["cube with a colour a side", "torus that hides a part of itself"])
def test_derivative_images_are_those_of_supersampled_pictures(name, parameter, axis):
    mesh = scene(name)
    direction = {parameter: torch.eye(3, dtype=torch.float64)[axis]}
    reference = finite_difference(mesh, direction)
    cosine, ratio = agreement(mesh, direction, reference, "antialias")
    assert cosine > 0.99 and abs(ratio - 1) < 0.03, (cosine, ratio)
    filtered, _ = agreement(mesh, direction, reference, "filter")
    assert 0.6 < filtered < 0.95, filtered  # the thesis' mode points the right way, but no more
