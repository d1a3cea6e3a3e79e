"""A globe's place, turn and light, found from one picture of it: the thesis' hello world (T figures
4-2 to 4-4).

python examples/globe.py
"""

import math
from functools import partial

import torch
from torch import Tensor

from habitus.mesh.shapes import sphere
from habitus.observe.camera import Camera
from habitus.observe.images import as_vector, gaussian_pyramid
from habitus.observe.lighting import spherical_harmonics
from habitus.render.draw import draw
from habitus.render.textures import Texture
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus.solve.minimize import Minimized, minimize


def continents(height: int = 256) -> Tensor:
    """A map (height, 2 height, 3) of a planet that is not ours: land where the sum of random waves
    in space is high.
    """
    random = torch.Generator().manual_seed(5)
    latitude = torch.pi * (0.5 - (torch.arange(height).double() + 0.5) / height)[:, None]
    longitude = torch.pi * ((torch.arange(2 * height).double() + 0.5) / height - 1)
    x = latitude.cos() * longitude.sin()
    y = latitude.sin().expand(-1, 2 * height)
    z = latitude.cos() * longitude.cos()
    waves = torch.randn(3, 80, generator=random).double() * torch.linspace(1, 9, 80)
    ground = (torch.stack([x, y, z], -1) @ waves + 7 * torch.rand(80, generator=random)).cos() @ (
        1 / waves.norm(dim=0)
    )
    land = (16 * ground[..., None] / ground.std() - 2).sigmoid()
    dry = (2 * ground[..., None] / ground.std() - 2).sigmoid()
    sea, grass, sand = torch.tensor(
        [[0.06, 0.2, 0.5], [0.2, 0.42, 0.15], [0.8, 0.68, 0.42]]
    ).double()
    return (1 - land) * sea + land * ((1 - dry) * grass + dry * sand)


# Geometry, texture and camera: the globe turns about the origin, 4 m before a camera that has y up.
globe = sphere(32, 64)
V = globe.vertices
F = Triangles.of(globe.faces, globe.vertices)
U = Camera.of(160, 120, focal_length=150, rotation=(math.pi, 0, 0), translation=(0, 0, 4))
texture = Texture.of(continents())


def render(translation: Tensor, rotation: Tensor, light: Tensor, camera: Camera = U) -> Tensor:
    """The picture (H, W, 3) of the globe at a place (3,), turned by a rotation vector (3,), in a
    light (9,).
    """
    turned = V @ matrix_from_rotvec(rotation).mT
    A = spherical_harmonics(turned, light)
    return draw(camera, turned + translation, F).textured(texture, globe.uv, brightness=A)


def recover(
    observed: Tensor, start: dict[str, Tensor], method: str = "dogleg", stages: bool = True, **more
) -> Minimized:
    """Place alone; then all 15 numbers, first on small pictures, where coasts 30 degrees apart
    still overlap.
    """

    def difference(finest: int, translation: Tensor, rotation: Tensor, light: Tensor) -> Tensor:
        error = render(translation, rotation, light) - observed
        return as_vector(
            gaussian_pyramid(error, num_levels=6, normalization="SSE", reference=observed)[finest:]
        )

    values = dict(start)
    if stages:
        place = partial(difference, 0, rotation=start["rotation"], light=start["light"])
        values |= minimize(
            place, {"translation": start["translation"]}, method, max_iterations=5, **more
        ).values
        values |= minimize(partial(difference, 3), values, method, max_iterations=10, **more).values
    return minimize(partial(difference, 0), values, method, **more)


def errors(found: dict[str, Tensor], truth: dict[str, Tensor]) -> tuple[float, float]:
    """How far a globe is from where it should be: metres, degrees."""
    turn, true_turn = (matrix_from_rotvec(each["rotation"]) for each in (found, truth))
    angle = rotvec_from_matrix(turn @ true_turn.mT).norm()
    return float((found["translation"] - truth["translation"]).norm()), math.degrees(angle)


def truth_and_start() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """A globe half a metre and 30 degrees off, in a light that is not known."""
    truth = {
        "translation": 0.5 * torch.tensor([2.0, 1.0, -2.0]).double() / 3,
        "rotation": math.radians(30) * torch.tensor([2.0, -2.0, 1.0]).double() / 3,
        "light": torch.tensor([1.0, 0.2, 0.3, -0.3, 0.0, 0.0, 0.1, 0.0, 0.0]).double(),
    }
    start = {name: torch.zeros_like(value) for name, value in truth.items()}
    start["light"][0] = 1.0
    return truth, start


def main() -> None:
    """Recover the globe and say how far off it is."""
    truth, start = truth_and_start()
    found = recover(render(**truth), start)
    for name, values in (("start", start), ("end", found.values)):
        metres, degrees = errors(values, truth)
        light = (values["light"] - truth["light"]).abs().max()
        print(
            f"{name:5s}  place {1e3 * metres:.3f} mm, turn {degrees:.3f} degrees, light "
            f"{light:.3f} off"
        )


if __name__ == "__main__":
    main()
