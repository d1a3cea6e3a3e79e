"""The corners of a tetrahedron, found from its silhouettes in three views: no colour, no light, no
correspondence.

python examples/silhouettes.py
"""

import torch
from torch import Tensor

from habitus.mesh.shapes import tetrahedron
from habitus.observe.camera import Camera, look_at
from habitus.observe.images import as_vector, gaussian_pyramid
from habitus.render.draw import draw
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec
from habitus.solve.minimize import minimize

solid = tetrahedron()
V = solid.vertices
F = Triangles.of(solid.faces, solid.vertices)
eyes = torch.tensor([[0.0, 1.0, 4.0], [3.5, 1.0, -2.0], [-3.5, 1.0, -2.0]]).double()
rotations, translations = look_at(eyes, torch.zeros(3).double())
U = Camera.of(
    160, 120, focal_length=150, rotation=rotations, translation=translations
)  # three cameras around it


def silhouettes(corners: Tensor) -> Tensor:
    """How much of each pixel the solid with these corners (4, 3) covers, in each view (3, 120, 160,
    1).
    """
    return draw(U, corners, F).silhouette()[..., None]


def recover(observed: Tensor, start: Tensor) -> Tensor:
    """The corners (4, 3) whose silhouettes are those observed."""

    def difference(corners: Tensor) -> Tensor:
        return as_vector(gaussian_pyramid(silhouettes(corners) - observed, num_levels=4))

    return minimize(difference, {"corners": start}).values["corners"]


def main() -> None:
    """Each corner is moved by some 30 cm; the tetrahedron's radius is a metre."""
    truth = V @ matrix_from_rotvec(torch.tensor([0.3, 0.4, 0.1]).double()).mT
    start = truth + 0.2 * torch.randn(4, 3, generator=torch.Generator().manual_seed(1)).double()
    for name, corners in (("start", start), ("end", recover(silhouettes(truth), start))):
        print(f"{name:5s}  corners {1e3 * (corners - truth).norm(dim=-1).max():.3f} mm off at most")


if __name__ == "__main__":
    main()
