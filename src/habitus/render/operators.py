"""The renderer's differentiable steps as torch functions: compiled on the CPU, `reference.py` on any other device.

Each supports reverse mode (compiled) and forward mode with `torch.func.jvp` and `jacfwd` (torch operations).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from habitus.errors import HabitusError
from habitus.render import image_kernels, reference, sample_kernels, surface_kernels
from habitus.render.parts import Parts
from habitus.render.threads import count_chunks, run_chunks
from habitus.render.triangles import Triangles, outside
from habitus.render.visibility import Seen, look


def visibility(
    screen: Float[Tensor, "V 3"], triangles: Triangles, width: int, height: int, cull: bool, edges: bool
) -> Seen:
    """`visibility.look` out of automatic differentiation's reach."""
    return outside(lambda plain: look(plain, triangles, width, height, cull, edges), screen)


def part_weights(screen: Float[Tensor, "V 3"], parts: Parts) -> Float[Tensor, " S"]:
    """The parts' weights, with the derivative of the area that moving edges sweep: -(normal velocity) integrated.

    It is the derivative of the pixel's exact coverage (Reynolds' transport theorem).
    """
    tail, head = screen[parts.tail, :2], screen[parts.head, :2]
    step = (head - tail).detach()
    middle = ((parts.start + parts.end) / 2).to(screen.dtype)
    scale = (parts.outward * (parts.end - parts.start)).to(screen.dtype)
    moved = (1 - middle)[:, None] * (tail - tail.detach()) + middle[:, None] * (head - head.detach())
    return parts.weight.to(screen.dtype) - scale * (step[:, 1] * moved[:, 0] - step[:, 0] * moved[:, 1])


def image(
    screen: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    values: Float[Tensor, "V C"],
    background: Float[Tensor, "K C"],
    weights: Float[Tensor, " S"],
    seen: Seen,
) -> Float[Tensor, "P C"]:
    """`compose` of `interpolate` of `barycentrics`: pixels (row by row) from values of vertices, in one go."""
    if values.device.type != "cpu":
        corners = faces[seen.faces]
        found = reference.interpolate(values, corners, reference.barycentrics(screen, corners, seen.points))
        return reference.compose(found, background, weights, seen)
    return _Image.apply(screen, values, background, weights, faces, seen)


def barycentrics(
    screen: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    sample_faces: Int[Tensor, " N"],
    points: Float[Tensor, "N 2"],
) -> Float[Tensor, "N 3"]:
    """Perspective-correct barycentric coordinates of fixed points (pixels) on faces that move with the screen."""
    if screen.device.type != "cpu":
        return reference.barycentrics(screen, faces[sample_faces], points)
    return _Barycentrics.apply(screen, faces, sample_faces, points)


def interpolate(
    values: Float[Tensor, "V C"],
    faces: Int[Tensor, "F 3"],
    sample_faces: Int[Tensor, " N"],
    coordinates: Float[Tensor, "N 3"],
) -> Float[Tensor, "N C"]:
    """Values at samples: their corners' mean, weighted by barycentric coordinates."""
    if values.device.type != "cpu":
        return reference.interpolate(values, faces[sample_faces], coordinates)
    return _Interpolate.apply(values, faces, sample_faces, coordinates)


def compose(
    values: Float[Tensor, "N C"], background: Float[Tensor, "K C"], weights: Float[Tensor, " S"], seen: Seen
) -> Float[Tensor, "P C"]:
    """Pixels (row by row) from values at samples, the background (one row, or one a pixel) and the weights of parts."""
    if values.device.type != "cpu":
        return reference.compose(values, background, weights, seen)
    part_pixel = seen.pixels[:0] if seen.parts is None else seen.parts.pixel
    return _Compose.apply(
        values, background, weights, seen.ids.numel(), seen.pixels, part_pixel, seen.inner, seen.outer
    )


class _Image(torch.autograd.Function):
    @staticmethod
    def forward(
        screen: Tensor, values: Tensor, background: Tensor, weights: Tensor, faces: Tensor, seen: Seen
    ) -> Tensor:
        ids, parts, starts = _plain(seen.ids), _plain_parts(seen, weights), _part_starts(seen)
        places, table, plain, behind = (_plain(array) for array in (screen, faces, values, background))
        image = np.empty((ids.size, plain.shape[1]), plain.dtype)

        def work(_: int, begin: int, end: int) -> None:
            surface_kernels.draw_values(places, table, ids, plain, behind, begin, end, image)
            surface_kernels.draw_jumps(places, table, plain, behind, parts, starts[begin], starts[end], image)

        run_chunks(work, len(ids), least=16, pieces=4)
        return torch.from_numpy(image)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*inputs[:5])
        ctx.save_for_forward(*inputs[:5])
        ctx.seen = inputs[5]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slopes: Tensor) -> Any:
        found = outside(lambda *tensors: _pull_image(*tensors, seen=ctx.seen), *ctx.saved_tensors, slopes)
        return (*found, None, None)

    @staticmethod
    def jvp(ctx: Any, screen_step: Tensor | None, values_step: Tensor | None, *steps: Any) -> Tensor:
        screen, values, background, weights, faces = ctx.saved_tensors
        seen, corners, moved = ctx.seen, faces[ctx.seen.faces], None
        coordinates = reference.barycentrics(screen, corners, seen.points)
        if screen_step is not None:
            moved = _barycentrics_step(screen[corners], coordinates, screen_step[corners])
        found = reference.interpolate(values, corners, coordinates)
        found_step = _interpolate_step(values, corners, coordinates, values_step, moved)
        pixel = seen.pixels[:0] if seen.parts is None else seen.parts.pixel
        lists = (seen.ids.numel(), seen.pixels, pixel, seen.inner, seen.outer)
        return _compose_step((found, background, weights), (found_step, *steps[:2]), *lists)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise _no_vmap()


class _Barycentrics(torch.autograd.Function):
    @staticmethod
    def forward(screen: Tensor, faces: Tensor, sample_faces: Tensor, points: Tensor) -> Tensor:
        out = torch.empty(len(sample_faces), 3, dtype=screen.dtype)
        corners, table, chosen, places = _plain(screen), _plain(faces), _plain(sample_faces), _plain(points)

        def work(_: int, begin: int, end: int) -> None:
            sample_kernels.barycentrics(corners, table, chosen, places, begin, end, out.numpy())

        run_chunks(work, len(out))
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*inputs, output)
        ctx.save_for_forward(*inputs, output)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slopes: Tensor) -> Any:
        return outside(_pull_barycentrics, *ctx.saved_tensors, slopes), None, None, None

    @staticmethod
    def jvp(ctx: Any, screen_step: Tensor, *_: Any) -> Tensor:
        screen, faces, sample_faces, _, coordinates = ctx.saved_tensors
        corners = faces[sample_faces]
        return _barycentrics_step(screen[corners], coordinates, screen_step[corners])

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise _no_vmap()


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(values: Tensor, faces: Tensor, sample_faces: Tensor, coordinates: Tensor) -> Tensor:
        out = torch.empty(len(sample_faces), values.shape[1], dtype=values.dtype)
        rows, table, chosen, weights = _plain(values), _plain(faces), _plain(sample_faces), _plain(coordinates)

        def work(_: int, begin: int, end: int) -> None:
            sample_kernels.interpolate(rows, table, chosen, weights, begin, end, out.numpy())

        run_chunks(work, len(out))
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slopes: Tensor) -> Any:
        to_values, to_coordinates = outside(_pull_interpolated, *ctx.saved_tensors, slopes)
        return to_values, None, None, to_coordinates

    @staticmethod
    def jvp(ctx: Any, values_step: Tensor | None, *steps: Any) -> Tensor:
        values, faces, sample_faces, coordinates = ctx.saved_tensors
        return _interpolate_step(values, faces[sample_faces], coordinates, values_step, steps[-1])

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise _no_vmap()


class _Compose(torch.autograd.Function):
    @staticmethod
    def forward(values: Tensor, background: Tensor, weights: Tensor, count: int, *lists: Tensor) -> Tensor:
        pixels, pixel, inner, outer = (_plain(array) for array in lists)
        plain, behind, weight = _plain(values), _plain(background), _plain(weights)
        image = np.empty((count, values.shape[1]), plain.dtype)
        run_chunks(lambda _, begin, end: image_kernels.lay_background(behind, begin, end, image), len(image))
        run_chunks(lambda _, begin, end: image_kernels.fill_pixels(pixels, plain, begin, end, image), len(pixels))
        image_kernels.add_jumps(pixel, weight, inner, outer, plain, behind, image)
        return torch.from_numpy(image)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.count, tensors = inputs[3], inputs[:3] + inputs[4:]
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slopes: Tensor) -> Any:
        found = outside(_pull_composed, *ctx.saved_tensors, slopes)
        return (*found, None, None, None, None, None)

    @staticmethod
    def jvp(ctx: Any, *steps: Any) -> Tensor:
        *given, pixels, pixel, inner, outer = ctx.saved_tensors
        return _compose_step(given, steps[:3], ctx.count, pixels, pixel, inner, outer)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise _no_vmap()


def _interpolate_step(
    values: Tensor, corners: Tensor, coordinates: Tensor, values_step: Tensor | None, step: Tensor | None
) -> Tensor:
    """How interpolated values change with the values of corners and with coordinates."""
    total = torch.zeros((), dtype=values.dtype)
    if values_step is not None:
        total = total + (coordinates[:, :, None] * values_step[corners]).sum(1)
    if step is not None:
        total = total + (step[:, :, None] * values[corners]).sum(1)
    return total


def _compose_step(
    given: Sequence[Tensor],
    steps: Sequence[Tensor | None],
    count: int,
    pixels: Tensor,
    pixel: Tensor,
    inner: Tensor,
    outer: Tensor,
) -> Tensor:
    """How an image changes with values at samples, the background and the weights of parts."""
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


def _plain_parts(seen: Seen, weights: Tensor) -> tuple[np.ndarray, ...]:
    """What kernels need of parts, with their weights."""
    parts = seen.parts
    if parts is None:
        none, nowhere = np.zeros(0, np.int64), np.zeros((0, 2))
        return none, _plain(weights), none, nowhere, none, nowhere
    lists = (parts.pixel, weights, parts.inner_face, parts.inner_point, parts.outer_face, parts.outer_point)
    return tuple(_plain(tensor) for tensor in lists)


def _part_starts(seen: Seen) -> np.ndarray:
    """Where the parts of each row of pixels begin, and behind them where the last row's end."""
    height, width = seen.ids.shape
    if seen.parts is None:
        return np.zeros(height + 1, np.int64)
    return np.searchsorted(_plain(seen.parts.pixel), np.arange(height + 1) * width)


def _pull_image(*tensors: Tensor, seen: Seen) -> tuple[Tensor, ...]:
    screen, values, behind, weights, faces, slopes = (_plain(tensor) for tensor in tensors)
    ids, parts, starts = _plain(seen.ids), _plain_parts(seen, tensors[3]), _part_starts(seen)
    chunks = count_chunks(len(ids), least=16)
    to_screen, to_values = np.zeros((chunks, *screen.shape)), np.zeros((chunks, *values.shape))
    to_weight, to_behind = np.empty_like(weights), np.zeros((chunks if len(behind) == 1 else 1, *behind.shape))

    def work(chunk: int, begin: int, end: int) -> None:
        to = to_screen[chunk], to_values[chunk], to_behind[chunk % len(to_behind)]
        surface_kernels.pull_values(screen, faces, ids, values, slopes, begin, end, *to)
        some = starts[begin], starts[end]
        surface_kernels.pull_jumps(screen, faces, values, behind, parts, slopes, *some, *to, to_weight)

    run_chunks(work, len(ids), least=16)
    found = to_screen.sum(0), to_values.sum(0), to_behind.sum(0), to_weight
    return tuple(torch.from_numpy(x).to(like.dtype) for x, like in zip(found, tensors[:4], strict=True))


def _pull_barycentrics(*tensors: Tensor) -> Tensor:
    screen, faces, sample_faces, points, coordinates, slopes = (_plain(tensor) for tensor in tensors)
    sums = np.zeros((count_chunks(len(slopes)), *screen.shape))

    def work(chunk: int, begin: int, end: int) -> None:
        sample_kernels.barycentrics_back(
            screen, faces, sample_faces, points, coordinates, slopes, begin, end, sums[chunk]
        )

    run_chunks(work, len(slopes))
    return torch.from_numpy(sums.sum(0)).to(tensors[0].dtype)


def _pull_interpolated(*tensors: Tensor) -> tuple[Tensor, Tensor]:
    values, faces, sample_faces, coordinates, slopes = (_plain(tensor) for tensor in tensors)
    sums, to_coordinates = np.zeros((count_chunks(len(slopes)), *values.shape)), np.empty_like(coordinates)

    def work(chunk: int, begin: int, end: int) -> None:
        sample_kernels.interpolate_back(
            values, faces, sample_faces, coordinates, slopes, begin, end, sums[chunk], to_coordinates
        )

    run_chunks(work, len(slopes))
    return torch.from_numpy(sums.sum(0)).to(tensors[0].dtype), torch.from_numpy(to_coordinates)


def _pull_composed(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    values, behind, weight, pixels, pixel, inner, outer, slopes = (_plain(tensor) for tensor in tensors)
    to_values, to_behind, to_weight = np.zeros_like(values), slopes.copy(), np.empty_like(weight)
    run_chunks(lambda _, begin, end: image_kernels.take_pixels(pixels, slopes, begin, end, to_values), len(pixels))
    to_behind[pixels] = 0.0
    to_behind = to_behind if len(behind) > 1 else to_behind.sum(0, keepdims=True)
    image_kernels.take_jumps(pixel, weight, inner, outer, values, behind, slopes, to_values, to_behind, to_weight)
    return torch.from_numpy(to_values), torch.from_numpy(to_behind), torch.from_numpy(to_weight)


def _barycentrics_step(corners: Tensor, coordinates: Tensor, step: Tensor) -> Tensor:
    """How coordinates (N, 3) at fixed points change as corners (N, 3, 3) move by `step`."""
    position, depth = corners[..., :2], corners[..., 2]
    flat = coordinates * depth
    flat = flat / flat.sum(-1, keepdim=True)
    opposite = position.roll(-2, -2) - position.roll(-1, -2)
    across = torch.stack([-opposite[..., 1], opposite[..., 0]], -1)
    area = (opposite[:, 2, 0] * -opposite[:, 1, 1] + opposite[:, 2, 1] * opposite[:, 1, 0])[:, None]
    moved = (flat[..., None] * step[..., :2]).sum(-2, keepdim=True)
    flat_step = -(across * moved).sum(-1) * (reference.share_of_pixel(position)[:, None] / area)
    part_step = flat_step / depth - flat * step[..., 2] / depth**2
    return (part_step - coordinates * part_step.sum(-1, keepdim=True)) / (flat / depth).sum(-1, keepdim=True)


def _plain(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _no_vmap() -> HabitusError:
    return HabitusError("vmap over a drawing is not supported: give cameras, vertices or values leading batch axes")
