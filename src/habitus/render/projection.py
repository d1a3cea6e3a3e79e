"""Points of the world on a camera's screen, compiled: `Camera.screen` with the same derivatives, in
one pass.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from habitus.observe.camera import Camera
from habitus.observe.lens import distorted
from habitus.render.clipping import Clipped, clip_near
from habitus.render.derivatives import as_array
from habitus.render.kernels import projection as kernels
from habitus.render.transforms import Operator, no_vmap, outside
from habitus.render.triangles import Triangles
from habitus.rotations import left_jacobian, matrix_from_rotvec

SIZES = (2, 2, 9, 3, 8)
"""Numbers of focal length, principal point, rotation matrix, translation and lens: the order of
`project_vjp`.
"""


def on_screen(
    camera: Camera, vertices: Tensor, triangles: Triangles
) -> tuple[Tensor, Triangles, Clipped | None]:
    """Vertices on the screen and what joins them, cut at the near plane where some are behind
    it.
    """
    if (
        vertices.device.type == "cpu"
        and vertices.dtype == camera.focal_length.dtype
        and len(vertices)
    ):
        screen = project(camera, vertices)
        if outside(lambda plain: bool(plain[:, 2].numpy().min() >= camera.near), screen):
            return screen, triangles, None
    points = camera.to_camera(vertices)
    clipped = clip_near(points, triangles, camera.near)
    points, triangles = (
        (points, triangles) if clipped is None else (clipped.points, clipped.triangles)
    )
    screen = torch.cat([camera.project_camera_points(points), points[:, 2:]], -1)
    return _shown(screen, points, camera), triangles, clipped


def _shown(screen: Tensor, points: Tensor, camera: Camera) -> Tensor:
    """The screen without vertices so far out that the lens' polynomials fold back there
    (`valid_radius_squared`).
    """
    if camera.distortion is None:
        return screen
    radius = (points[:, :2] ** 2).sum(-1) / points[:, 2].clamp(min=camera.near / 2) ** 2
    return torch.where((radius < camera.valid_radius_squared())[:, None], screen, math.nan)


def project(camera: Camera, points: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
    """u, v (pixels) and depth (m) of points of the world, all of them in front of one camera, on
    the CPU.

    NaN where the lens' polynomials fold back (`Camera.valid_radius_squared`); other points than in
    front have no meaning.
    """
    numbers = camera.focal_length, camera.principal_point, camera.rotation, camera.translation
    lens = points.new_zeros(8) if camera.distortion is None else camera.distortion
    bends = camera.distortion is not None and outside(lambda plain: bool(plain.any()), lens)
    limit = camera.valid_radius_squared() if bends else points.new_full((), math.inf)
    return _Project.apply(points, *numbers, lens, limit)


def _numbers(tensors: Sequence[Tensor]) -> tuple[np.ndarray, ...]:
    """Focal length, principal point, rotation vector, translation and lens in float64."""
    return tuple(as_array(tensor).astype(np.float64) for tensor in tensors)


class _Project(Operator):
    @staticmethod
    def forward(points: Tensor, *given: Tensor) -> Tensor:
        *numbers, limit = given
        screen = np.empty(points.shape, as_array(points).dtype)
        kernels.project(as_array(points), *_numbers(numbers), limit.item(), screen)
        return torch.from_numpy(screen)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return (*outside(_vjp, *ctx.saved_tensors, cotangent), None)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        given = ctx.saved_tensors[:-1]
        limit = ctx.saved_tensors[-1]
        steps = (
            torch.zeros_like(x) if dx is None else dx
            for x, dx in zip(given, tangents[:-1], strict=True)
        )
        return _jvp(given, tuple(steps), limit)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise no_vmap()


def _jvp(given: Sequence[Tensor], steps: Sequence[Tensor], limit: Tensor) -> Tensor:
    """The derivative of the screen along steps of points and of the camera's numbers."""
    points, focal, _, rotation, shift, lens = given
    d_points, d_focal, d_middle, d_rotation, d_shift, d_lens = steps
    turn = matrix_from_rotvec(rotation)
    turned = points @ turn.mT
    axis = left_jacobian(rotation) @ d_rotation
    moved = turned + shift
    d_moved = d_points @ turn.mT + torch.linalg.cross(axis.expand_as(turned), turned) + d_shift
    plane = moved[:, :2] / moved[:, 2:]
    d_plane = (d_moved[:, :2] - plane * d_moved[:, 2:]) / moved[:, 2:]
    seen = ((plane * plane).sum(-1) < limit)[:, None]
    pixels = (
        _distorted_jvp(plane, lens, d_plane, d_lens) * focal
        + distorted(plane, lens) * d_focal
        + d_middle
    )
    return torch.where(seen, torch.cat([pixels, d_moved[:, 2:]], -1), 0.0)


def _distorted_jvp(plane: Tensor, lens: Tensor, d_plane: Tensor, d_lens: Tensor) -> Tensor:
    """The derivative of `lens.distorted` along steps of (x', y') and of the lens."""
    (k1, k2, p1, p2, k3, k4, k5, k6), (l1, l2, q1, q2, l3, l4, l5, l6) = (
        lens.unbind(),
        d_lens.unbind(),
    )
    (x, y), (dx, dy) = plane.unbind(-1), d_plane.unbind(-1)
    s = x * x + y * y
    ds = 2 * (x * dx + y * dy)
    xy = 2 * x * y
    d_xy = 2 * (x * dy + y * dx)
    below = 1 + s * (k4 + s * (k5 + s * k6))
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / below
    d_above = s * (l1 + s * (l2 + s * l3)) + (k1 + s * (2 * k2 + 3 * s * k3)) * ds
    d_below = s * (l4 + s * (l5 + s * l6)) + (k4 + s * (2 * k5 + 3 * s * k6)) * ds
    d_radial = (d_above - radial * d_below) / below
    across = (
        dx * radial
        + x * d_radial
        + q1 * xy
        + p1 * d_xy
        + q2 * (s + 2 * x * x)
        + p2 * (ds + 4 * x * dx)
    )
    down = (
        dy * radial
        + y * d_radial
        + q1 * (s + 2 * y * y)
        + p1 * (ds + 4 * y * dy)
        + q2 * xy
        + p2 * d_xy
    )
    return torch.stack([across, down], -1)


def _vjp(points: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Cotangents of points and of the camera's numbers. tensors: these numbers, the limit, the
    screen's cotangent.
    """
    *given, limit, cotangent = tensors
    numbers = _numbers(given)
    to_points = np.empty(points.shape, as_array(points).dtype)
    sums = np.zeros(sum(SIZES))
    kernels.project_vjp(
        as_array(points), *numbers, limit.item(), as_array(cotangent), to_points, sums
    )
    to_focal, to_middle, to_turn, to_shift, to_lens = np.split(sums, np.cumsum(SIZES)[:-1])
    by_turn = matrix_from_rotvec(numbers[2]) @ to_turn.reshape(3, 3).T
    axis = np.array(
        [
            by_turn[1, 2] - by_turn[2, 1],
            by_turn[2, 0] - by_turn[0, 2],
            by_turn[0, 1] - by_turn[1, 0],
        ]
    )
    to_rotation = left_jacobian(numbers[2]).T @ axis
    gradients = to_focal, to_middle, to_rotation, to_shift, to_lens
    cotangents = (
        torch.from_numpy(array).to(like.dtype) for array, like in zip(gradients, given, strict=True)
    )
    return torch.from_numpy(to_points), *cotangents
