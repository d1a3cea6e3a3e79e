"""What the operators' derivatives are made of: steps forward in torch, pulls backward by compiled kernels."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from habitus.kernels.threads import count_chunks, run_chunks
from habitus.render.kernels import images as image_kernels
from habitus.render.kernels import samples as sample_kernels
from habitus.render.kernels import surfaces as surface_kernels
from habitus.render.reference import images as reference
from habitus.render.visibility import Visibility


def interpolate_step(
    values: Tensor, corners: Tensor, coordinates: Tensor, values_step: Tensor | None, step: Tensor | None
) -> Tensor:
    """How interpolated values change with the values of corners and with coordinates."""
    total = torch.zeros((), dtype=values.dtype)
    if values_step is not None:
        total = total + (coordinates[:, :, None] * values_step[corners]).sum(1)
    if step is not None:
        total = total + (step[:, :, None] * values[corners]).sum(1)
    return total


def compose_step(
    given: Sequence[Tensor],
    steps: Sequence[Tensor | None],
    count: int,
    pixels: Tensor,
    pixel: Tensor,
    inner: Tensor,
    outer: Tensor,
) -> Tensor:
    """How an image changes with values at samples, the background and the weights of fragments."""
    values, background, weights = given
    values_step, background_step, weights_step = (
        torch.zeros_like(at) if step is None else step for at, step in zip(given, steps, strict=True)
    )
    behind, behind_step = background.expand(count, -1), background_step.expand(count, -1)
    jump = _rows(values, outer, behind[pixel]) - _rows(values, inner, behind[pixel])
    jump_step = _rows(values_step, outer, behind_step[pixel]) - _rows(values_step, inner, behind_step[pixel])
    change = weights_step[:, None] * jump + weights[:, None] * jump_step
    image = behind_step.index_copy(0, pixels, values_step.expand(len(values), -1)[: len(pixels)])
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
        none, nowhere = np.zeros(0, np.int64), np.zeros((0, 2))
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


def pull_image(*tensors: Tensor, visibility: Visibility) -> tuple[Tensor, ...]:
    """Slopes to screen, values, background and weights from those to an image of `surface_kernels.draw_values`.

    tensors: screen, values, background, weights, faces, and the slopes to the image.
    """
    screen, values, behind, weights, faces, slopes = (as_array(tensor) for tensor in tensors)
    ids, fragments, starts = (
        as_array(visibility.ids),
        fragment_arrays(visibility, tensors[3]),
        fragment_starts(visibility),
    )
    chunks = count_chunks(len(ids), least=16)
    to_screen, to_values = np.zeros((chunks, *screen.shape)), np.zeros((chunks, *values.shape))
    to_weight, to_behind = np.empty_like(weights), np.zeros((chunks if len(behind) == 1 else 1, *behind.shape))

    def work(chunk: int, begin: int, end: int) -> None:
        to = to_screen[chunk], to_values[chunk], to_behind[chunk % len(to_behind)]
        surface_kernels.pull_values(screen, faces, ids, values, slopes, begin, end, *to)
        some = starts[begin], starts[end]
        surface_kernels.pull_jumps(screen, faces, values, behind, fragments, slopes, *some, *to, to_weight)

    run_chunks(work, len(ids), least=16)
    found = to_screen.sum(0), to_values.sum(0), to_behind.sum(0), to_weight
    return tuple(torch.from_numpy(x).to(like.dtype) for x, like in zip(found, tensors[:4], strict=True))


def pull_barycentrics(*tensors: Tensor) -> Tensor:
    """Slopes to the screen. tensors: screen, faces, the samples' faces, points and coordinates, slopes to these."""
    screen, faces, sample_faces, points, coordinates, slopes = (as_array(tensor) for tensor in tensors)
    sums = np.zeros((count_chunks(len(slopes)), *screen.shape))

    def work(chunk: int, begin: int, end: int) -> None:
        sample_kernels.barycentrics_back(
            screen, faces, sample_faces, points, coordinates, slopes, begin, end, sums[chunk]
        )

    run_chunks(work, len(slopes))
    return torch.from_numpy(sums.sum(0)).to(tensors[0].dtype)


def pull_interpolated(*tensors: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes to values and coordinates.

    tensors: values, faces, the samples' faces and coordinates, slopes to the samples' values.
    """
    values, faces, sample_faces, coordinates, slopes = (as_array(tensor) for tensor in tensors)
    sums, to_coordinates = np.zeros((count_chunks(len(slopes)), *values.shape)), np.empty_like(coordinates)

    def work(chunk: int, begin: int, end: int) -> None:
        sample_kernels.interpolate_back(
            values, faces, sample_faces, coordinates, slopes, begin, end, sums[chunk], to_coordinates
        )

    run_chunks(work, len(slopes))
    return torch.from_numpy(sums.sum(0)).to(tensors[0].dtype), torch.from_numpy(to_coordinates)


def pull_composed(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes to samples, background and weights.

    tensors: values at samples, background, weights, the lists of `compose`, slopes to pixels.
    """
    values, behind, weight, pixels, pixel, inner, outer, slopes = (as_array(tensor) for tensor in tensors)
    to_values, to_behind, to_weight = np.zeros_like(values), slopes.copy(), np.empty_like(weight)
    run_chunks(lambda _, begin, end: image_kernels.take_pixels(pixels, slopes, begin, end, to_values), len(pixels))
    to_behind[pixels] = 0.0
    to_behind = to_behind if len(behind) > 1 else to_behind.sum(0, keepdims=True)
    image_kernels.take_jumps(pixel, weight, inner, outer, values, behind, slopes, to_values, to_behind, to_weight)
    return torch.from_numpy(to_values), torch.from_numpy(to_behind), torch.from_numpy(to_weight)


def barycentrics_step(corners: Tensor, coordinates: Tensor, step: Tensor) -> Tensor:
    """How coordinates (N, 3) at fixed points change as corners (N, 3, 3) move by `step`."""
    position, depth = corners[..., :2], corners[..., 2]
    flat = coordinates * depth
    flat = flat / flat.sum(-1, keepdim=True)
    opposite = position.roll(-2, -2) - position.roll(-1, -2)
    across = torch.stack([-opposite[..., 1], opposite[..., 0]], -1)
    area = (opposite[:, 2, 0] * -opposite[:, 1, 1] + opposite[:, 2, 1] * opposite[:, 1, 0])[:, None]
    moved = (flat[..., None] * step[..., :2]).sum(-2, keepdim=True)
    flat_step = -(across * moved).sum(-1) * (reference.share_of_pixel(position)[:, None] / area)
    share_tangent = flat_step / depth - flat * step[..., 2] / depth**2
    return (share_tangent - coordinates * share_tangent.sum(-1, keepdim=True)) / (flat / depth).sum(-1, keepdim=True)


def as_array(tensor: Tensor) -> np.ndarray:
    """A tensor's numbers, contiguous."""
    return tensor.detach().contiguous().numpy()
