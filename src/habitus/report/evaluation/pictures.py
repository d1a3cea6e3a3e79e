"""Pictures of the evaluation report: surfaces coloured by error, drawn with the project's
renderer.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera, look_at
from habitus.render.draw import draw
from habitus.render.triangles import Triangles

Rgba = UInt8[np.ndarray, "H W 4"]
ERROR_RAMP = ("#ece7df", "#f7d48a", "#f0934a", "#cf3f4b", "#6a1b5f")
"""Colours from no error to the largest; pale is good, on light and dark pages alike."""
CHANGE_RAMP = ("#2364aa", "#8fbfe0", "#ece7df", "#f2a679", "#c0392b")
"""Colours from thinner to thicker than at rest."""
PLAIN = "#b9b2a7"
DISTANCE = 8.0  # from the camera to what it looks at, in sizes of that: nearly without perspective
DARKEST = 0.45  # light where the surface is seen from the side


def error_colours(
    errors: Float[np.ndarray, " V"],
    limit: float,
    ramp: Sequence[str] = ERROR_RAMP,
    low: float = 0.0,
) -> Float[np.ndarray, "V 3"]:
    """Colours (0 to 1) of values from ``low`` to ``limit``, cut off there."""
    place = np.clip((errors - low) / max(limit - low, 1e-12), 0.0, 1.0) * (len(ramp) - 1)
    stops = np.array([rgb(colour) for colour in ramp])
    return np.stack([np.interp(place, np.arange(len(ramp)), stops[:, k]) for k in range(3)], 1)


def rgb(colour: str) -> tuple[float, ...]:
    """Red, green, blue (0 to 1) of "#rrggbb"."""
    return tuple(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))


def plain_colours(count: int) -> Float[np.ndarray, "V 3"]:
    """Grey for all."""
    return np.tile(rgb(PLAIN), (count, 1))


def front_and_back(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    height: int = 520,
) -> Rgba:
    """A standing person (m, y up, facing +z) from before and from behind, side by side."""
    views = [
        picture(vertices, faces, colours, (0.0, 0.0, side), height=height) for side in (1.0, -1.0)
    ]
    return side_by_side(views)


def picture(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    towards: Sequence[float],
    *,
    height: int = 420,
    frame: Float[np.ndarray, "n 3"] | None = None,
) -> Rgba:
    """A surface (m, y up) seen from the direction ``towards``, on nothing; the points of ``frame``
    (m) fill the height.

    Without ``frame`` all of the surface is in the picture, whose width is what it needs.
    """
    points = np.asarray(vertices if frame is None else frame, float)
    back = np.asarray(towards, float) / np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    across = np.stack([points @ right, points @ np.cross(back, right), points @ back])
    low = across.min(1)
    high = across.max(1)
    size = high - low
    middle = np.stack([right, np.cross(back, right), back], 1) @ ((low + high) / 2)
    tall = float(max(size[1], size[0] / 1.6)) * 1.04
    width = int(np.clip(np.ceil(height * size[0] * 1.04 / tall), height // 4, 2 * height))
    away = DISTANCE * max(tall, float(size[2]))
    eye = torch.from_numpy(middle + away * back)
    rotation, translation = look_at(eye, torch.from_numpy(middle))
    camera = Camera.of(
        width, height, height * away / tall, rotation=rotation, translation=translation
    )
    surface = torch.from_numpy(np.ascontiguousarray(vertices, float))
    corners = torch.from_numpy(np.array(faces))
    light = vertex_normals(surface, corners) @ torch.from_numpy(_light(back, right))
    shade = DARKEST + (1 - DARKEST) * light.clamp(min=0.0)
    seen = draw(camera, surface, Triangles.of(corners, num_vertices=len(surface)))
    shaded = torch.from_numpy(np.asarray(colours, float)) * shade[:, None]
    layers = seen.image(torch.cat([shaded, torch.ones_like(shade)[:, None]], 1)).numpy()
    return _bytes(layers)


def _light(back: np.ndarray, right: np.ndarray) -> Float[np.ndarray, " 3"]:
    """From where light comes: over the viewer's left shoulder."""
    direction = back - 0.35 * right + np.array([0.0, 0.45, 0.0])
    return direction / np.linalg.norm(direction)


def _bytes(layers: Float[np.ndarray, "H W 4"]) -> Rgba:
    """Colours that were multiplied by coverage, as a picture whose colours are not."""
    cover = np.clip(layers[..., 3:], 0.0, 1.0)
    colour = np.where(cover > 1e-3, layers[..., :3] / np.maximum(cover, 1e-3), 0.0)
    return np.round(255 * np.clip(np.concatenate([colour, cover], -1), 0.0, 1.0)).astype(np.uint8)


def side_by_side(pictures: Sequence[Rgba], gap: int = 12) -> Rgba:
    """Pictures of one height beside each other."""
    space = np.zeros((pictures[0].shape[0], gap, 4), np.uint8)
    parts = [part for each in pictures for part in (space, each)][1:]
    return np.concatenate(parts, 1)
