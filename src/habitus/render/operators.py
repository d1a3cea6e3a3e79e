"""The renderer's differentiable operators as torch functions: kernels on the CPU, `reference/` on
any other device.

Each has a VJP (reverse mode, compiled) and a JVP (`torch.func.jvp` and `jacfwd`, in torch
operations).
"""

from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from habitus.kernels.threads import run_chunks
from habitus.render.derivatives import (
    as_array,
    barycentrics_jvp,
    barycentrics_vjp,
    compose_jvp,
    compose_vjp,
    fragment_arrays,
    fragment_starts,
    image_vjp,
    interpolate_jvp,
    interpolate_vjp,
    rows_of_chunk,
)
from habitus.render.kernels import images as image_kernels
from habitus.render.kernels import samples as sample_kernels
from habitus.render.kernels import surfaces as surface_kernels
from habitus.render.rasterize import rasterize
from habitus.render.reference import images as reference
from habitus.render.transforms import Operator, no_vmap, of_one_type, outside
from habitus.render.triangles import Triangles, Visibility


def rasterize_detached(
    screen: Float[Tensor, "V 3"],
    triangles: Triangles,
    width: int,
    height: int,
    cull: bool,
    edges: bool,
    exact: bool,
) -> Visibility:
    """`rasterize.rasterize` out of automatic differentiation's reach."""
    return outside(
        lambda value_array: rasterize(value_array, triangles, width, height, cull, edges, exact),
        screen,
    )


def image(
    screen: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    values: Float[Tensor, "V C"],
    background: Float[Tensor, "K C"],
    weights: Float[Tensor, " S"],
    visibility: Visibility,
    are_depths: bool = False,
) -> Float[Tensor, "P C"]:
    """`compose` of `interpolate` of `barycentrics`: pixels (row by row) from values of vertices, in
    one go.

    are_depths: the values are the screen's depths, which the rasteriser has at pixels already.
    """
    if values.device.type != "cpu":
        corners = faces[visibility.faces]
        shares = reference.barycentrics(screen, corners, visibility.points, visibility.exact)
        colours = reference.interpolate(values, corners, shares)
        return reference.compose(colours, background, weights, visibility)
    return _Image.apply(screen, values, background, weights, faces, visibility, are_depths)


def barycentrics(
    screen: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    sample_faces: Int[Tensor, " N"],
    points: Float[Tensor, "N 2"],
    exact: bool = False,
) -> Float[Tensor, "N 3"]:
    """Perspective-correct barycentric coordinates of fixed points (pixels) on faces that move with
    the screen.

    exact: slivers count in full.
    """
    if screen.device.type != "cpu":
        return reference.barycentrics(screen, faces[sample_faces], points, exact)
    return _Barycentrics.apply(screen, faces, sample_faces, points, exact)


def interpolate(
    values: Float[Tensor, "V C"],
    faces: Int[Tensor, "F 3"],
    sample_faces: Int[Tensor, " N"],
    coordinates: Float[Tensor, "N 3"],
) -> Float[Tensor, "N C"]:
    """Values at samples: their corners' mean, weighted by barycentric coordinates."""
    values, coordinates = of_one_type(values, coordinates)
    if values.device.type != "cpu":
        return reference.interpolate(values, faces[sample_faces], coordinates)
    return _Interpolate.apply(values, faces, sample_faces, coordinates)


def compose(
    values: Float[Tensor, "N C"],
    background: Float[Tensor, "K C"],
    weights: Float[Tensor, " S"],
    visibility: Visibility,
) -> Float[Tensor, "P C"]:
    """Pixels (row by row) from values at samples, the background (one row, or one a pixel) and
    fragment weights.
    """
    if values.device.type != "cpu":
        return reference.compose(values, background, weights, visibility)
    part_pixel = (
        visibility.pixels[:0] if visibility.fragments is None else visibility.fragments.pixel
    )
    return _Compose.apply(
        values,
        background,
        weights,
        visibility.ids.numel(),
        visibility.pixels,
        part_pixel,
        visibility.inner,
        visibility.outer,
    )


class _Image(Operator):
    @staticmethod
    def forward(
        screen: Tensor,
        values: Tensor,
        background: Tensor,
        weights: Tensor,
        faces: Tensor,
        visibility: Visibility,
        are_depths: bool,
    ) -> Tensor:
        ids = as_array(visibility.ids)
        starts = fragment_starts(visibility)
        fragments = fragment_arrays(visibility, weights)
        arrays = (as_array(array) for array in (screen, faces, values, background))
        screen_array, face_array, value_array, background_array = arrays
        image = np.empty((ids.size, value_array.shape[1]), value_array.dtype)
        inverse = (
            as_array(visibility.inverse) if are_depths and visibility.inverse is not None else None
        )

        def work(_: int, begin: int, end: int) -> None:
            if inverse is None:
                surface_kernels.draw_values(
                    screen_array, face_array, ids, value_array, background_array, begin, end, image
                )
            else:
                surface_kernels.draw_depths(inverse, ids, background_array, begin, end, image)
            surface_kernels.draw_jumps(
                screen_array,
                face_array,
                value_array,
                background_array,
                fragments,
                starts[begin],
                starts[end],
                image,
            )

        run_chunks(work, len(ids), least=rows_of_chunk(ids), pieces=4)
        return torch.from_numpy(image)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*inputs[:5])
        ctx.save_for_forward(*inputs[:5])
        ctx.visibility = inputs[5]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        vjp = partial(image_vjp, visibility=ctx.visibility, to_background=ctx.needs_input_grad[2])
        found = outside(vjp, *ctx.saved_tensors, cotangent)
        return (*found, None, None, None)

    @staticmethod
    def jvp(
        ctx: Any, screen_tangent: Tensor | None, values_tangent: Tensor | None, *steps: Any
    ) -> Tensor:
        screen, values, background, weights, faces = ctx.saved_tensors
        visibility = ctx.visibility
        corners = faces[ctx.visibility.faces]
        moved = None
        coordinates = reference.barycentrics(screen, corners, visibility.points)
        if screen_tangent is not None:
            moved = barycentrics_jvp(
                screen[corners], coordinates, screen_tangent[corners], visibility.exact
            )
        found = reference.interpolate(values, corners, coordinates)
        found_tangent = interpolate_jvp(values, corners, coordinates, values_tangent, moved)
        pixel = (
            visibility.pixels[:0] if visibility.fragments is None else visibility.fragments.pixel
        )
        lists = (
            visibility.ids.numel(),
            visibility.pixels,
            pixel,
            visibility.inner,
            visibility.outer,
        )
        return compose_jvp((found, background, weights), (found_tangent, *steps[:2]), *lists)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise no_vmap()


class _Barycentrics(Operator):
    @staticmethod
    def forward(
        screen: Tensor, faces: Tensor, sample_faces: Tensor, points: Tensor, exact: bool
    ) -> Tensor:
        out = torch.empty(len(sample_faces), 3, dtype=screen.dtype)
        arrays = [as_array(tensor) for tensor in (screen, faces, sample_faces, points)]

        def work(_: int, begin: int, end: int) -> None:
            sample_kernels.barycentrics(*arrays, begin, end, out.numpy())

        run_chunks(work, len(out))
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.exact = inputs[4]
        ctx.save_for_backward(*inputs[:4], output)
        ctx.save_for_forward(*inputs[:4], output)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        found = outside(partial(barycentrics_vjp, exact=ctx.exact), *ctx.saved_tensors, cotangent)
        return found, None, None, None, None

    @staticmethod
    def jvp(ctx: Any, screen_tangent: Tensor, *_: Any) -> Tensor:
        screen, faces, sample_faces, _, coordinates = ctx.saved_tensors
        corners = faces[sample_faces]
        return barycentrics_jvp(screen[corners], coordinates, screen_tangent[corners], ctx.exact)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise no_vmap()


class _Interpolate(Operator):
    @staticmethod
    def forward(values: Tensor, faces: Tensor, sample_faces: Tensor, coordinates: Tensor) -> Tensor:
        out = torch.empty(len(sample_faces), values.shape[1], dtype=values.dtype)
        arrays = [as_array(tensor) for tensor in (values, faces, sample_faces, coordinates)]

        def work(_: int, begin: int, end: int) -> None:
            sample_kernels.interpolate(*arrays, begin, end, out.numpy())

        run_chunks(work, len(out))
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        to_values, to_coordinates = outside(interpolate_vjp, *ctx.saved_tensors, cotangent)
        return to_values, None, None, to_coordinates

    @staticmethod
    def jvp(ctx: Any, values_tangent: Tensor | None, *steps: Any) -> Tensor:
        values, faces, sample_faces, coordinates = ctx.saved_tensors
        return interpolate_jvp(values, faces[sample_faces], coordinates, values_tangent, steps[-1])

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise no_vmap()


class _Compose(Operator):
    @staticmethod
    def forward(
        values: Tensor, background: Tensor, weights: Tensor, count: int, *lists: Tensor
    ) -> Tensor:
        pixels, pixel, inner, outer = (as_array(array) for array in lists)
        value_array = as_array(values)
        background_array = as_array(background)
        weight = as_array(weights)
        image = np.empty((count, values.shape[1]), value_array.dtype)
        run_chunks(
            lambda _, begin, end: image_kernels.lay_background(background_array, begin, end, image),
            len(image),
        )
        run_chunks(
            lambda _, begin, end: image_kernels.fill_pixels(pixels, value_array, begin, end, image),
            len(pixels),
        )
        image_kernels.add_jumps(pixel, weight, inner, outer, value_array, background_array, image)
        return torch.from_numpy(image)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.count = inputs[3]
        tensors = inputs[:3] + inputs[4:]
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        found = outside(compose_vjp, *ctx.saved_tensors, cotangent)
        return (*found, None, None, None, None, None)

    @staticmethod
    def jvp(ctx: Any, *steps: Any) -> Tensor:
        *given, pixels, pixel, inner, outer = ctx.saved_tensors
        return compose_jvp(given, steps[:3], ctx.count, pixels, pixel, inner, outer)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise no_vmap()
