"""Derivatives of the operators: Jacobian-vector products (jvp) in torch, vector-Jacobian products
(vjp) in kernels; and `Camera.screen` compiled, with the same derivatives, in one pass.

A vjp takes the cotangent of an output, the derivative of some number to it, and gives those of the
inputs. `render/README.md` has the formulas.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from habitus.kernels.threads import count_chunks, run_chunks
from habitus.observe.camera import Camera
from habitus.observe.lens import distorted
from habitus.render.clipping import Clipped, clip_near
from habitus.render.kernels import images as image_kernels
from habitus.render.kernels import projection as kernels
from habitus.render.kernels import samples as sample_kernels
from habitus.render.kernels import surfaces_vjp as vjp_kernels
from habitus.render.reference import images as reference
from habitus.render.transforms import Operator, no_vmap, outside
from habitus.render.triangles import EdgeFragments, Triangles, Visibility
from habitus.rotations import left_jacobian, matrix_from_rotvec


def interpolate_jvp(
    values: Tensor,
    corners: Tensor,
    coordinates: Tensor,
    values_tangent: Tensor | None,
    tangent: Tensor | None,
) -> Tensor:
    """The derivative of interpolated values along tangents of the values and of barycentric
    coordinates.
    """
    total = torch.zeros((), dtype=values.dtype)
    if values_tangent is not None:
        total = total + (coordinates[:, :, None] * values_tangent[corners]).sum(1)
    if tangent is not None:
        total = total + (tangent[:, :, None] * values[corners]).sum(1)
    return total


def compose_jvp(
    given: Sequence[Tensor],
    tangents: Sequence[Tensor | None],
    count: int,
    pixels: Tensor,
    pixel: Tensor,
    inner: Tensor,
    outer: Tensor,
) -> Tensor:
    """The derivative of an image along tangents of values at samples, the background and the
    weights of fragments.
    """
    values, background, weights = given
    values_tangent, background_tangent, weights_tangent = (
        torch.zeros_like(at) if tangent is None else tangent
        for at, tangent in zip(given, tangents, strict=True)
    )
    behind = background.expand(count, -1)
    behind_tangent = background_tangent.expand(count, -1)
    jump = _rows(values, outer, behind[pixel]) - _rows(values, inner, behind[pixel])
    outer_tangent = _rows(values_tangent, outer, behind_tangent[pixel])
    jump_tangent = outer_tangent - _rows(values_tangent, inner, behind_tangent[pixel])
    change = weights_tangent[:, None] * jump + weights[:, None] * jump_tangent
    image = behind_tangent.index_copy(
        0, pixels, values_tangent.expand(len(values), -1)[: len(pixels)]
    )
    return image.index_add(0, pixel, torch.where(jump.isfinite(), change, 0.0))


def _rows(values: Tensor, index: Tensor, behind: Tensor) -> Tensor:
    """Rows of values; where the index is -1, `behind`."""
    if not len(values):
        return behind
    return torch.where((index >= 0)[:, None], values[index.clamp(min=0)], behind)


def fragment_arrays(visibility: Visibility, weights: Tensor) -> tuple[np.ndarray, ...]:
    """What kernels need of fragments, with their weights."""
    fragments = visibility.fragments
    if fragments is None:
        none = np.zeros(0, np.int64)
        nowhere = np.zeros((0, 2))
        return none, as_array(weights), none, nowhere, none, nowhere
    lists = (
        fragments.pixel,
        weights,
        fragments.inner_face,
        fragments.inner_point,
        fragments.outer_face,
        fragments.outer_point,
    )
    return tuple(as_array(tensor) for tensor in lists)


def fragment_starts(visibility: Visibility) -> np.ndarray:
    """Where the fragments of each row of pixels begin, and behind them where the last row's end."""
    height, width = visibility.ids.shape
    if visibility.fragments is None:
        return np.zeros(height + 1, np.int64)
    return np.searchsorted(as_array(visibility.fragments.pixel), np.arange(height + 1) * width)


def rows_of_chunk(ids: np.ndarray) -> int:
    """How many rows of pixels are worth a chunk of their own."""
    return 1 + 20_000 // ids.shape[1]


def image_vjp(
    *tensors: Tensor, visibility: Visibility, to_background: bool
) -> tuple[Tensor | None, ...]:
    """Cotangents of screen, values, background and weights from that of an image of
    `kernels.surfaces.draw_values`.

    tensors: screen, values, background, weights, faces, and the cotangent of the image.
    to_background: whether the background's is wanted; None else.
    """
    screen, values, behind, weights, faces, cotangent = (as_array(tensor) for tensor in tensors)
    ids = as_array(visibility.ids)
    fragments = fragment_arrays(visibility, tensors[3])
    starts = fragment_starts(visibility)
    least = rows_of_chunk(ids)
    exact = visibility.exact
    chunks = count_chunks(len(ids), least)
    to_screen = np.zeros((chunks, *screen.shape))
    to_values = np.zeros((chunks, *values.shape))
    rows = len(behind) if to_background else 0
    to_weight = np.empty_like(weights)
    to_behind = np.zeros((chunks if rows == 1 else 1, rows, behind.shape[1]))

    def work(chunk: int, begin: int, end: int) -> None:
        to = to_screen[chunk], to_values[chunk], to_behind[chunk % len(to_behind)]
        vjp_kernels.draw_values_vjp(screen, faces, ids, values, cotangent, exact, begin, end, *to)
        some = starts[begin], starts[end]
        given = screen, faces, values, behind, fragments, cotangent, exact
        vjp_kernels.draw_jumps_vjp(*given, *some, *to, to_weight)

    run_chunks(work, len(ids), least)
    sums = to_screen.sum(0), to_values.sum(0), to_behind.sum(0), to_weight
    gradients = [
        torch.from_numpy(array).to(like.dtype)
        for array, like in zip(sums, tensors[:4], strict=True)
    ]
    return gradients[0], gradients[1], gradients[2] if to_background else None, gradients[3]


def fragment_weights_vjp(screen: Tensor, cotangent: Tensor, fragments: EdgeFragments) -> Tensor:
    """The cotangent of the screen from that of edge fragments' weights."""
    names = ("tail", "head", "start", "end", "outward")
    lists = tuple(as_array(getattr(fragments, name)) for name in names)
    gradient = np.zeros(screen.shape, as_array(screen).dtype)
    image_kernels.fragment_weights_vjp(as_array(screen), lists, as_array(cotangent), gradient)
    return torch.from_numpy(gradient)


def barycentrics_vjp(*tensors: Tensor, exact: bool) -> Tensor:
    """The cotangent of the screen. tensors: screen, faces, the samples' faces, points, coordinates
    and cotangent.
    """
    screen, faces, sample_faces, points, coordinates, cotangent = (
        as_array(tensor) for tensor in tensors
    )
    sums = np.zeros((count_chunks(len(cotangent)), *screen.shape))

    def work(chunk: int, begin: int, end: int) -> None:
        sample_kernels.barycentrics_vjp(
            screen,
            faces,
            sample_faces,
            points,
            coordinates,
            cotangent,
            exact,
            begin,
            end,
            sums[chunk],
        )

    run_chunks(work, len(cotangent))
    return torch.from_numpy(sums.sum(0)).to(tensors[0].dtype)


def interpolate_vjp(*tensors: Tensor) -> tuple[Tensor, Tensor]:
    """Cotangents of values and coordinates.

    tensors: values, faces, the samples' faces and coordinates, cotangent of the samples' values.
    """
    values, faces, sample_faces, coordinates, cotangent = (as_array(tensor) for tensor in tensors)
    sums = np.zeros((count_chunks(len(cotangent)), *values.shape))
    to_coordinates = np.empty_like(coordinates)

    def work(chunk: int, begin: int, end: int) -> None:
        sample_kernels.interpolate_vjp(
            values,
            faces,
            sample_faces,
            coordinates,
            cotangent,
            begin,
            end,
            sums[chunk],
            to_coordinates,
        )

    run_chunks(work, len(cotangent))
    return torch.from_numpy(sums.sum(0)).to(tensors[0].dtype), torch.from_numpy(to_coordinates)


def compose_vjp(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cotangents of samples, background and weights.

    tensors: values at samples, background, weights, the lists of `compose`, cotangent of the
    pixels.
    """
    values, behind, weight, pixels, pixel, inner, outer, cotangent = (
        as_array(tensor) for tensor in tensors
    )
    to_values = np.zeros_like(values)
    to_behind = cotangent.copy()
    to_weight = np.empty_like(weight)
    fill = image_kernels.fill_pixels_vjp
    run_chunks(lambda _, begin, end: fill(pixels, cotangent, begin, end, to_values), len(pixels))
    to_behind[pixels] = 0.0
    to_behind = to_behind if len(behind) > 1 else to_behind.sum(0, keepdims=True)
    image_kernels.add_jumps_vjp(
        pixel, weight, inner, outer, values, behind, cotangent, to_values, to_behind, to_weight
    )
    return torch.from_numpy(to_values), torch.from_numpy(to_behind), torch.from_numpy(to_weight)


def barycentrics_jvp(corners: Tensor, coordinates: Tensor, tangent: Tensor, exact: bool) -> Tensor:
    """The derivative of coordinates (N, 3) at fixed points as corners (N, 3, 3) move along
    `tangent`.
    """
    position = corners[..., :2]
    depth = corners[..., 2]
    flat = coordinates * depth
    flat = flat / flat.sum(-1, keepdim=True)
    opposite = position.roll(-2, -2) - position.roll(-1, -2)
    across = torch.stack([-opposite[..., 1], opposite[..., 0]], -1)
    area = (opposite[:, 2, 0] * -opposite[:, 1, 1] + opposite[:, 2, 1] * opposite[:, 1, 0])[:, None]
    moved = (flat[..., None] * tangent[..., :2]).sum(-2, keepdim=True)
    share = 1.0 if exact else reference.share_of_pixel(position)[:, None]
    flat_tangent = -(across * moved).sum(-1) * (share / area)
    share_tangent = flat_tangent / depth - flat * tangent[..., 2] / depth**2
    return (share_tangent - coordinates * share_tangent.sum(-1, keepdim=True)) / (flat / depth).sum(
        -1, keepdim=True
    )


def as_array(tensor: Tensor) -> np.ndarray:
    """A tensor as a C-contiguous NumPy array of its own type."""
    return tensor.detach().contiguous().numpy()


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
