"""Small pictures for a table of many captures: a person at rest, and a few moments of a motion side
by side.
"""

import numpy as np
from jaxtyping import Float, Int, UInt8

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.body.up import up_rotation
from habitus.export.png import small_png
from habitus.rotations import matrix_from_rotvec

HEIGHT, STEP, MARGIN = 84, 46, 16
"""Pixels: of the picture, from one moment to the next, and more on both sides of the row."""
MOMENTS = 4
TALL = 2.05
"""Metres that the height shows; a motion that reaches higher is shown smaller."""
_FINE = 2  # points drawn a pixel, each way
_VIEW = np.radians(35.0)  # from the front
_LIGHT = np.array([-0.45, 0.6, 0.66])
_DARK = np.array([58, 50, 46])
_PALE = np.array([226, 212, 194])


def palette() -> UInt8[np.ndarray, "16 3"]:
    """Nothing, then fifteen shades of skin from dark to pale."""
    shades = _DARK + np.linspace(0.0, 1.0, 15)[:, None] * (_PALE - _DARK)
    return np.concatenate([np.zeros((1, 3)), shades]).round().astype(np.uint8)


def motion_picture(moving: Moving) -> bytes:
    """A PNG of `MOMENTS` moments of a motion on one floor, seen from the front's left of one in the
    middle.
    """
    frames = np.linspace(0, moving.num_frames - 1, 2 * MOMENTS + 1)[1::2].round().astype(int)
    upright = moving.vertices(list(frames)) @ up_rotation(moving.up_axis).T
    facing = (
        up_rotation(moving.up_axis)
        @ _root(moving, int(frames[MOMENTS // 2]))
        @ np.array([0.0, 0.0, 1.0])
    )
    turned = upright @ _camera(np.arctan2(facing[0], facing[2]) - _VIEW).T
    floor = turned[..., 1].min()
    top = turned[..., 1].max()
    scale = HEIGHT / max(TALL, 1.02 * (top - floor))
    levels = np.zeros((HEIGHT, STEP * (MOMENTS - 1) + 2 * (MARGIN + STEP // 2)), np.uint8)
    for k, body in enumerate(turned):
        middle = (body[:, 0].min() + body[:, 0].max()) / 2
        points = (body - [middle, floor, 0.0]) * scale
        _draw(levels, points, np.asarray(moving.body.faces), MARGIN + STEP // 2 + k * STEP)
    return small_png(levels, palette())


def shape_picture(body: BodyModel, betas: Float[np.ndarray, " B"]) -> bytes:
    """A PNG of a person at rest from the front's left."""
    rest = np.asarray(body.rest_vertices(betas)) @ _camera(-_VIEW / 2).T
    levels = np.zeros((HEIGHT, HEIGHT), np.uint8)
    middle = (rest[:, 0].min() + rest[:, 0].max()) / 2
    points = (rest - [middle, rest[:, 1].min(), 0.0]) * (
        HEIGHT / max(TALL, 1.02 * np.ptp(rest[:, 1]))
    )
    _draw(levels, points, np.asarray(body.faces), HEIGHT // 2)
    return small_png(levels, palette())


def _camera(angle: float) -> Float[np.ndarray, "3 3"]:
    """Axes to the right, up and to the viewer, who stands where this angle from +z about +y
    points.
    """
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])


def _root(moving: Moving, frame: int) -> Float[np.ndarray, "3 3"]:
    return np.asarray(matrix_from_rotvec(moving.pose[frame, 0]))


def _draw(
    levels: UInt8[np.ndarray, "H W"],
    points: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    x: int,
):
    """Draw a surface, in pixels from its floor's middle, over what is there: near points last, each
    a dot.
    """
    a, b, c = points[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    front = normal[:, 2] > 0
    a, b, c, normal = (some[front] for some in (a, b, c, normal))
    light = (
        normal
        @ (_LIGHT / np.linalg.norm(_LIGHT))
        / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    )
    shade = np.clip(1 + np.round(14 * (0.12 + 0.88 * np.clip(light, 0, 1))), 1, 15).astype(np.uint8)
    dots = np.concatenate([(u * a + v * b + (1 - u - v) * c) for u, v in _SPOTS])
    order = np.argsort(dots[:, 2], kind="stable")
    height, width = levels.shape
    column = np.floor(_FINE * (dots[order, 0] + x)).astype(int)
    row = np.floor(_FINE * (height - dots[order, 1] - 1)).astype(int)
    inside = (column >= 0) & (column < _FINE * width) & (row >= 0) & (row < _FINE * height)
    fine = np.zeros((_FINE * height, _FINE * width), np.uint8)
    fine[row[inside], column[inside]] = np.tile(shade, len(_SPOTS))[order][inside]
    parts = fine.reshape(height, _FINE, width, _FINE).astype(float)
    count = (parts > 0).sum(axis=(1, 3))
    mean = np.round(parts.sum(axis=(1, 3)) / np.maximum(count, 1)).astype(np.uint8)
    levels[:] = np.where(2 * count >= _FINE**2, mean, levels)


_SPOTS = ((1 / 3, 1 / 3), (0.6, 0.2), (0.2, 0.6), (0.2, 0.2))  # of a triangle
