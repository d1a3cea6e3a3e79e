"""A cube's pose, found from edges of a picture that has more light than the model knows of (T
figure 4-5).

python examples/edges.py
"""

import math
from functools import partial

import torch
from torch import Tensor

from habitus.mesh.shapes import cube
from habitus.observe.camera import Camera
from habitus.observe.images import as_vector, edges, gaussian_pyramid
from habitus.render.draw import draw
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec
from habitus.solve.minimize import minimize

box = cube()
V = box.vertices
F = Triangles.of(box.faces, box.vertices)
A = box.vertices + 0.5  # colours say where a corner is
U = Camera.of(160, 120, focal_length=150, translation=(0, 0, 3))
truth = {
    "translation": torch.tensor([0.1, -0.1, 0.0]).double(),
    "rotation": torch.tensor([0.5, 0.6, 0.1]).double(),
}


def render(translation: Tensor, rotation: Tensor) -> Tensor:
    """The picture (120, 160, 3) of the cube at a place (3,), turned by a rotation vector (3,)."""
    return draw(U, V @ matrix_from_rotvec(rotation).mT + translation, F).image(A)


def recover(observed: Tensor, start: dict[str, Tensor], use_edges: bool) -> dict[str, Tensor]:
    """The pose at which the two pictures differ least, pixel by pixel or edge by edge: moved first,
    then turned too.
    """

    def difference(translation: Tensor, rotation: Tensor) -> Tensor:
        levels = gaussian_pyramid(render(translation, rotation) - observed, num_levels=5)
        return as_vector(
            [edge for level in levels for edge in edges(level)] if use_edges else levels
        )

    place = partial(difference, rotation=start["rotation"])
    moved = minimize(place, {"translation": start["translation"]}, max_iterations=5)
    return minimize(difference, {**start, **moved.values}).values


def main() -> None:
    """Ten centimetres and eight degrees off; a quarter of white is added to every pixel, as haze or
    a lamp would.
    """
    observed = render(**truth) + 0.25
    start = {
        "translation": truth["translation"] + torch.tensor([0.06, -0.08, 0.0]),
        "rotation": truth["rotation"] + math.radians(8) * torch.tensor([0.0, 0.8, -0.6]),
    }
    poses = {name: recover(observed, start, name == "edges") for name in ("pixels", "edges")}
    for name, pose in {"start": start, **poses}.items():
        off = {key: (value - truth[key]).norm() for key, value in pose.items()}
        print(
            f"{name:6s}  {1e3 * off['translation']:.3f} mm, {math.degrees(off['rotation']):.3f} "
            "degrees off"
        )


if __name__ == "__main__":
    main()
