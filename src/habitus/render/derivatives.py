"""Derivatives of the operators: Jacobian-vector products (jvp) in torch, vector-Jacobian products
(vjp) in kernels.

A vjp takes the cotangent of an output, the derivative of some number to it, and gives those of the
inputs. `render/README.md` has the formulas.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from habitus.kernels.threads import count_chunks, run_chunks
from habitus.render.kernels import images as image_kernels
from habitus.render.kernels import samples as sample_kernels
from habitus.render.kernels import surfaces_vjp as vjp_kernels
from habitus.render.reference import images as reference
from habitus.render.visibility import EdgeFragments, Visibility


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
