"""A cube's pose, found from eighteen numbers about its picture: area, centroid and spread of each
colour (T 4.5).

python examples/moments.py
"""

import math

import torch
from torch import Tensor

from habitus.mesh.shapes import cube
from habitus.observe.camera import Camera
from habitus.observe.images import central_moments
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


def summary(translation: Tensor, rotation: Tensor) -> Tensor:
    """The moments (6, 3) of the cube's picture at a place (3,), turned by a rotation vector
    (3,).
    """
    return central_moments(draw(U, V @ matrix_from_rotvec(rotation).mT + translation, F).image(A))


def recover(observed: Tensor, start: dict[str, Tensor]) -> dict[str, Tensor]:
    """The pose whose moments are those observed; as shares of these, since areas and spreads differ
    by far in size.
    """
    return minimize(
        lambda translation, rotation: summary(translation, rotation) / observed - 1, start
    ).values


def main() -> None:
    """Half a metre and 20 degrees off."""
    observed = summary(**truth)
    start = {
        "translation": truth["translation"] + torch.tensor([0.3, 0.0, 0.4]),
        "rotation": truth["rotation"] + math.radians(20) * torch.tensor([0.0, 0.8, -0.6]),
    }
    for name, values in (("start", start), ("end", recover(observed, start))):
        off = {key: (value - truth[key]).norm() for key, value in values.items()}
        print(
            f"{name:5s}  {1e3 * off['translation']:.3f} mm, {math.degrees(off['rotation']):.3f} "
            "degrees off"
        )


if __name__ == "__main__":
    main()
