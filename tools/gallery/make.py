"""Draws the renderer's gallery (docs/gallery.md): images of a body and of a globe, kinds of
borders, a fit's progress.

python tools/gallery/make.py [--out docs/images]
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import habitus
from habitus.mesh.normals import vertex_normals
from habitus.mesh.shapes import sphere, torus
from habitus.observe.camera import Camera, look_at
from habitus.observe.lighting import spherical_harmonics
from habitus.render.draw import draw
from habitus.render.frame import BOUNDARIES, Frame
from habitus.render.textures import Texture
from habitus.render.triangles import Triangles

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples"))
import globe as example

DAYLIGHT = torch.tensor([0.75, 0.25, 0.3, -0.25, 0, 0, 0.05, 0, 0], dtype=torch.float64)
SEA, SHORE, LAND, PEAK = torch.tensor(
    [[0.1, 0.25, 0.55], [0.85, 0.8, 0.6], [0.25, 0.5, 0.2], [0.7, 0.6, 0.5]]
).double()
POSE = {
    "left_shoulder": (0.1, -0.5, -0.75),
    "right_shoulder": (0.3, 0.4, 0.8),
    "left_elbow": (0, -1.4, 0),
    "right_elbow": (0, 0.9, 0),
    "left_hip": (-0.6, 0, 0.05),
    "left_knee": (0.7, 0, 0),
    "right_hip": (0.25, 0, -0.05),
    "neck": (0, 0.35, 0),
}


def body_images(width: int, height: int) -> list[Tensor]:
    """The default body in mid-stride."""
    body = habitus.load_body("default")
    surface = body(
        pose={name: torch.tensor(turn, dtype=torch.float64) for name, turn in POSE.items()}
    )
    vertices = surface.vertices
    faces = surface.faces
    camera = view(
        width, height, eye=(-1.6, 0.5, 3.4), target=(0.02, -0.12, 0.05), focal=1.95 * height
    )
    normals = vertex_normals(vertices, faces)
    frame = draw(camera, vertices, Triangles.of(faces, vertices))
    colour = frame.image(
        spherical_harmonics(normals, DAYLIGHT) * torch.tensor([0.95, 0.75, 0.65]).double(), 1.0
    )
    return [colour, *others(frame, normals)]


def globe_images(width: int, height: int) -> list[Tensor]:
    """A globe with a mipmapped texture; the seam of its doubled vertices runs down the side away
    from the camera.
    """
    ball = sphere(24, 48)
    assert ball.uv is not None
    camera = view(width, height, eye=(-1.2, 1.4, 3.6), target=(0, 0, 0), focal=1.7 * height)
    frame = draw(camera, ball.vertices, Triangles.of(ball.faces, ball.vertices))
    light = spherical_harmonics(ball.vertices, DAYLIGHT)
    return [
        frame.textured(Texture.of(planet()), ball.uv, brightness=light, background=1.0),
        *others(frame, ball.vertices),
    ]


def others(frame: Frame, normals: Tensor) -> list[Tensor]:
    """Depth (near is dark), normals, silhouette, boundary and triangles, each as a picture (H, W,
    3).
    """
    coverage = frame.silhouette()[..., None]
    depth = frame.depth(background=torch.full((frame.height, frame.width), 1e3).double())[..., None]
    inside = depth[(frame.face_ids >= 0) & ~frame.boundary]
    grey = 0.85 * (depth - inside.min()) / (inside.max() - inside.min())
    grey = torch.where(depth > inside.max(), 1.0, grey)
    ids = frame.face_ids.long()
    palette = (
        torch.rand(
            len(frame.triangles.faces), 3, generator=torch.Generator().manual_seed(0)
        ).double()
        * 0.8
        + 0.15
    )
    triangles = torch.where((ids >= 0)[..., None], palette[ids.clamp(min=0)], 1.0)
    bump = (frame.normals(normals) + coverage) / 2 + 1 - coverage
    flat = [coverage, frame.boundary[..., None].double()]
    return [
        grey.expand(-1, -1, 3),
        bump,
        *(1 - 0.9 * image.expand(-1, -1, 3) for image in flat),
        triangles,
    ]


def border_images(size: int, enlarge: int) -> list[list[Tensor]]:
    """A part of a ring in few pixels: above, the picture in each boundary mode; below, its change
    as the ring moves.

    Red grows, blue shrinks, as the ring moves to the right.
    """
    ring = torus(60, 30)
    turn = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    triangles = Triangles.of(ring.faces, ring.vertices)
    camera = view(size, size, eye=(0.7, 2.2, 3.0), target=(0.6, 0, 0.5), focal=1.9 * size)
    values = 0.8 * spherical_harmonics(vertex_normals(ring.vertices, ring.faces), DAYLIGHT)
    above = []
    below = []
    for mode in BOUNDARIES:
        picture, change = torch.func.jvp(
            lambda place, mode=mode: draw(
                camera.replace(translation=place), ring.vertices, triangles, mode
            ).image(values),
            (camera.translation,),
            (turn,),
        )
        above.append(picture.expand(-1, -1, 3))
        below.append(red_and_blue(change[..., 0] / 10.0))
    return [[gutter(block(image, enlarge)) for image in row] for row in (above, below)]


def convergence_images(size: int, shown: tuple[int, ...]) -> list[list[Tensor]]:
    """How `examples/globe.py` finds its globe: what it draws at the start, after some iterations
    and at the end.

    Last what it is to find; below, how far each is from it, dark where it is far.
    """
    truth, start = example.truth_and_start()
    camera = example.U.scaled(size / example.U.height)
    steps = [start]

    def keep(iteration: int, values: dict[str, Tensor], cost: float) -> None:
        steps.append({**steps[-1], **values})

    example.recover(example.render(**truth), start, callback=keep)
    margin = (camera.width - size) // 2
    *drawn, observed = (
        example.render(**values, camera=camera)[:, margin : margin + size]
        for values in [*(steps[k] for k in shown), steps[-1], truth]
    )
    off = [
        1 - 1.5 * (picture - observed).abs().mean(-1, keepdim=True).expand(-1, -1, 3)
        for picture in [*drawn, observed]
    ]
    return [[gutter(image) for image in row] for row in ([*drawn, observed], off)]


def planet(height: int = 512, seed: int = 8) -> Tensor:
    """A map (height, 2 height, 3) of a planet that is not ours: random waves in space make its
    land.
    """
    latitude = torch.pi * (0.5 - (torch.arange(height).double() + 0.5) / height)[:, None]
    longitude = torch.pi * ((torch.arange(2 * height).double() + 0.5) / height - 1)
    x = latitude.cos() * longitude.sin()
    y = latitude.sin().expand(-1, 2 * height)
    z = latitude.cos() * longitude.cos()
    random = np.random.default_rng(seed)
    waves = torch.tensor(random.normal(size=(3, 60)) * random.uniform(1.5, 9, 60))
    phases = torch.tensor(random.uniform(0, 2 * np.pi, 60))
    ground = (torch.stack([x, y, z], -1) @ waves + phases).cos() @ (1 / waves.norm(dim=0))
    ground = (ground / ground.std())[..., None]
    colours = torch.where(
        ground < 0, SEA * (1 + 0.15 * ground), LAND + (PEAK - LAND) * (ground / 2.5).clamp(max=1)
    )
    return torch.where((ground - 0.05).abs() < 0.05, SHORE, colours).clamp(0, 1)


def view(width: int, height: int, eye: tuple, target: tuple, focal: float) -> Camera:
    """A camera at `eye` that looks at `target`."""
    rotation, translation = look_at(
        *(torch.tensor(point, dtype=torch.float64) for point in (eye, target))
    )
    return Camera.of(width, height, focal, rotation=rotation, translation=translation)


def red_and_blue(values: Tensor) -> Tensor:
    """Red for 1, white for 0, blue for -1, as (H, W, 3)."""
    up = values.clamp(0, 1)
    down = (-values).clamp(0, 1)
    return torch.stack([1 - down, 1 - up - down, 1 - up], -1)


def block(image: Tensor, times: int) -> Tensor:
    """Each pixel as a square."""
    return image.repeat_interleave(times, 0).repeat_interleave(times, 1)


def gutter(image: Tensor, size: int = 6) -> Tensor:
    """White around a picture."""
    return torch.nn.functional.pad(image, (0, 0, size, size, size, size), value=1.0)


def write(path: Path, rows: list[list[Tensor]]) -> None:
    """One picture of rows of pictures."""
    whole = torch.cat([torch.cat(row, 1) for row in rows], 0).clamp(0, 1)
    Image.fromarray((whole * 255).round().byte().numpy()).save(path, optimize=True)
    print(f"wrote {path}: {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Write all pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    write(out / "render-body.png", [body_images(190, 380)])
    write(out / "render-planet.png", [globe_images(190, 190)])
    write(out / "render-borders.png", border_images(28, 10))
    write(out / "render-convergence.png", convergence_images(180, (0, 2, 5, 7, 9)))


if __name__ == "__main__":
    main()
