"""Small scenes for the renderer's tests: (camera, vertices, triangles)."""

import torch

from habitus.mesh.shapes import cube, icosphere, sphere, torus
from habitus.observe.camera import Camera, look_at
from habitus.render.triangles import Triangles, join
from habitus.rotations import matrix_from_rotvec

WIDTH = 48
HEIGHT = 36


def camera(width: int = WIDTH, height: int = HEIGHT, eye=(0.4, 1.3, 2.1), **more) -> Camera:
    place = torch.tensor(eye, dtype=torch.float64)
    rotation, translation = look_at(place, torch.zeros(3, dtype=torch.float64))
    return Camera.of(width, height, 1.1 * width, rotation=rotation, translation=translation, **more)


def scene(name: str) -> tuple[Camera, torch.Tensor, Triangles]:
    generator = torch.Generator().manual_seed(3)
    turn = matrix_from_rotvec(torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64)).T
    if name == "torus":
        shape = torus(20, 14)
    elif name == "sphere with a seam":
        shape = sphere(10, 16)
    elif name == "hard cube":
        shape = cube()
    elif name == "soup":
        vertices = torch.randn(60, 3, generator=generator, dtype=torch.float64) * 0.6
        return camera(), vertices, Triangles.of(torch.arange(60).reshape(-1, 3), vertices)
    elif name == "sheet seen from both sides":
        u, v = torch.meshgrid(torch.linspace(-1, 1, 9), torch.linspace(-1, 1, 9), indexing="ij")
        vertices = (
            torch.stack([u, torch.sin(3 * u) * torch.cos(2 * v) * 0.5, v], -1)
            .reshape(-1, 3)
            .double()
            @ turn
        )
        corner = (torch.arange(8)[:, None] * 9 + torch.arange(8)).flatten()
        faces = torch.cat(
            [
                torch.stack([corner, corner + 1, corner + 9], -1),
                torch.stack([corner + 1, corner + 10, corner + 9], -1),
            ]
        )
        return camera(), vertices, Triangles.of(faces, vertices)
    elif name == "two spheres, one in front and one through the near plane":
        ball = icosphere(2)
        apart = torch.tensor([[0.3, 0.9, 1.4]], dtype=torch.float64)
        parts = Triangles.of(ball.faces, ball.vertices)
        return (
            camera(near=1.0),
            torch.cat([ball.vertices, ball.vertices * 0.4 + apart]),
            join(parts, parts),
        )
    else:
        raise KeyError(name)
    vertices = shape.vertices @ turn
    return camera(), vertices, Triangles.of(shape.faces, vertices)


SCENES = (
    "torus",
    "sphere with a seam",
    "hard cube",
    "soup",
    "sheet seen from both sides",
    "two spheres, one in front and one through the near plane",
)
