"""Derivatives of images as explicit sparse matrices, for Gauss-Newton (T 4.4, eqs 4.1 and 4.2).

    jacobian = image_jacobian(frame, values)
    jacobian.screen, jacobian.values                      # df/dU, df/dA
    jacobian.to_vertices(camera, vertices)                # df/dV = df/dU dU/dV
    jacobian.to_camera(camera, vertices)                  # df/dC = df/dU dU/dC, by the camera's fields
    jacobian.chain(camera, vertices, vertex_jacobian)     # df/dp of whatever moves vertices, by its dV/dp

Rows are the image's numbers as `image.flatten()` has them, columns those of a parameter in the same
way. All is float64 and equals what automatic differentiation gives, in each of the three boundary
modes, and where the near plane cuts. A batch is a list of frames. A term of
`habitus.solve.minimize` gives them beside its residual:

    def difference(translation):
        moved = camera.replace(translation=translation)
        frame = draw(moved, vertices, triangles)
        jacobian = lambda: image_jacobian(frame, values).to_camera(moved, vertices, ["translation"])
        return frame.image(values) - observed, jacobian
"""  # noqa: E501

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from habitus.render import operators
from habitus.render.frame import Frame
from habitus.render.jacobians.samples import (
    Array,
    Bsr,
    Csr,
    Mix,
    Samples,
    Table,
    as_array64,
    per_channel,
)
from habitus.render.jacobians.screen import ScreenJacobian, matrix, screen_blocks
from habitus.render.reference import textures as reference_textures
from habitus.render.textures import Texture, halve


@dataclass(frozen=True, eq=False)
class ImageJacobian(ScreenJacobian):
    """The derivative of `Frame.image`; values: df/dA, (H W, V), the same for each channel."""

    values: Csr

    def chain_values(self, jacobian: Any) -> Any:
        """df/dp = df/dA dA/dp for parameters p that change the values, such as lights: (H W C, P).

        jacobian: dA/dp, (V C, P) or (V, C, *P), an array or a tensor, or sparse, which gives a
        sparse matrix.
        """
        count, vertices = self.values.shape
        channels = self.blocks.shape[0] // count
        given = matrix(jacobian, vertices * channels, "derivatives of the values")
        if sparse.issparse(given):
            return sparse.kron(self.values, sparse.eye_array(channels), format="csr") @ given
        width = given.shape[1]
        return (self.values @ given.reshape(vertices, channels * width)).reshape(
            count * channels, width
        )


@dataclass(frozen=True, eq=False)
class TexturedJacobian(ScreenJacobian):
    """The derivative of `Frame.textured`, to what lays the texture on too.

    uv: (H W C, 2 U). texels: (H W C, T C'), of all levels; `mipmap_matrix` leads on to the
    texture's image. brightness: (H W C, V C'), None where there is none. C' is C, or 1 where one
    number serves all channels.
    """

    uv: Csr
    texels: Csr
    brightness: Csr | None


def image_jacobian(
    frame: Frame, values: Float[Tensor, "V C"], background: Float[Tensor, "*size _"] | float = 0.0
) -> ImageJacobian:
    """The derivative of `frame.image(values, background)`.

    HabitusError: shapes that do not fit; some channels that jump by an infinite amount where others
    do not.
    """
    values = values.detach()
    sampled = frame.at_samples(values)
    samples = Samples.of(frame)
    table = Table.of(frame)
    mix = Mix.of(frame, as_array64(sampled), background)
    rows = samples.rows(table)
    at_vertices = values if frame.clipped is None else frame.clipped.extend(values)
    derivatives = _corner_derivatives(as_array64(at_vertices), rows)
    blocks = screen_blocks(frame, samples, mix, derivatives, _still(frame, sampled, background))
    to_rows = mix.spread(rows, samples.coordinates[:, :, None, None], len(table.ends)).tocsr()
    if frame.clipped is None:
        return ImageJacobian(frame, blocks, None, to_rows)
    each = sparse.kron(to_rows, sparse.eye_array(values.shape[1]), format="csr")
    return ImageJacobian(
        frame, blocks, each @ table.to_fractions(as_array64(values)), to_rows @ table.to_given(1)
    )


def depth_jacobian(
    frame: Frame, background: Float[Tensor, "H W"] | float = math.inf
) -> ScreenJacobian:
    """The derivative of `frame.depth(background)`, C = 1. What it shows is the screen's own z."""
    samples = Samples.of(frame)
    behind = background
    if isinstance(background, Tensor):
        behind = background[..., None]
    derivatives = _corner_derivatives(samples.screen[:, 2:], samples.corners)
    found = (derivatives[0] * samples.coordinates.T).sum(0)[:, None]
    still = frame.depth(background)[..., None] if frame.mode == "filter" else None
    mix = Mix.of(frame, found, behind)
    return ScreenJacobian(
        frame,
        screen_blocks(frame, samples, mix, derivatives, still, is_depth=True),
        _no_cuts(frame),
    )


def silhouette_jacobian(frame: Frame) -> ScreenJacobian:
    """The derivative of `frame.silhouette()`, C = 1."""
    mix = Mix.of(frame, np.ones((len(frame.visibility.faces), 1)), 0.0)
    still = frame.silhouette()[..., None] if frame.mode == "filter" else None
    return ScreenJacobian(
        frame, screen_blocks(frame, Samples.of(frame), mix, None, still), _no_cuts(frame)
    )


def textured_jacobian(
    frame: Frame,
    texture: Texture,
    uv: Float[Tensor, "U 2"],
    uv_faces: Int[Tensor, "F 3"] | None = None,
    brightness: Float[Tensor, "V C"] | None = None,
    background: Float[Tensor, "*size _"] | float = 0.0,
) -> TexturedJacobian:
    """The derivative of `frame.textured` with the same arguments and errors. The level at a sample
    has none.
    """
    frame.check_uv(uv, uv_faces)
    samples = Samples.of(frame)
    table = Table.of(frame, len(uv), None if uv_faces is None else as_array64(uv_faces))
    rows = samples.rows(table)
    tapped = _Tapped.of(frame, texture, uv.detach(), uv_faces, len(samples.corners))
    found = tapped.values
    along = tapped.along
    light = np.ones((1, 1))
    lights = None
    lit = Table.of(frame)
    derivatives = np.einsum("nka,nca->ckn", table.at_rows(as_array64(uv))[rows], along)
    if brightness is not None:
        light = as_array64(frame.at_samples(brightness.detach()))[: len(found)]
        lights = _corner_derivatives(lit.at_rows(as_array64(brightness)), samples.rows(lit))
        derivatives = derivatives * light.T[:, None] + found.T[:, None] * lights
    image = found * light
    mix = Mix.of(frame, image, background)
    channels = image.shape[1]
    blocks = screen_blocks(
        frame, samples, mix, derivatives, _still(frame, torch.from_numpy(image), background)
    )

    def spread(to: Array, each: Array, count: int) -> Bsr:
        each = np.broadcast_to(each, (len(found), to.shape[1], channels, each.shape[-1]))
        return mix.spread(to, each, count)

    shares = samples.coordinates[:, :, None, None]
    to_uv = spread(rows, shares * (along * light[..., None])[:, None], len(table.ends)).tocsr()
    to_texels = spread(
        tapped.texel, tapped.weight[:, :, None, None] * light[:, None, :, None], len(texture.texels)
    )
    cuts = None if frame.clipped is None else to_uv @ table.to_fractions(as_array64(uv))
    to_light = None
    if brightness is not None:
        to_light = per_channel(
            spread(samples.rows(lit), shares * found[:, None, :, None], len(lit.ends)),
            light.shape[1],
        )
        cuts = None if cuts is None else cuts + to_light @ lit.to_fractions(as_array64(brightness))
        to_light = to_light if frame.clipped is None else to_light @ lit.to_given(light.shape[1])
    to_uv = to_uv if frame.clipped is None else to_uv @ table.to_given(2)
    return TexturedJacobian(
        frame, blocks, cuts, to_uv, per_channel(to_texels, found.shape[1]), to_light
    )


def mipmap_matrix(texture: Texture) -> Csr:
    """The texels (T) of all levels from those of the first (h w), row by row, as `Texture.of` makes
    them: (T, h w).
    """
    level = sparse.eye_array(math.prod(texture.sizes[0]), format="csr")
    levels = [level]
    for height, width in texture.sizes[:-1]:
        down, across = (
            sparse.csr_array(halve(torch.eye(n, dtype=torch.float64), 0).numpy())
            for n in (height, width)
        )
        levels.append(sparse.kron(down, across, format="csr") @ levels[-1])
    return sparse.vstack(levels, format="csr")


@dataclass(frozen=True, eq=False)
class _Tapped:
    """The texels under N samples, their weights; the samples' values (N, C) and derivatives along u
    and v (N, C, 2).
    """

    texel: Int[Array, "N k"]
    weight: Float[Array, "N k"]
    values: Float[Array, "N C"]
    along: Float[Array, "N C 2"]

    @staticmethod
    def of(
        frame: Frame, texture: Texture, uv: Tensor, uv_faces: Tensor | None, count: int
    ) -> "_Tapped":
        """Those of the first `count` samples of a frame."""
        corners, corner_uv = frame._corner_values(uv, uv_faces)
        at = operators.interpolate(
            corner_uv, corners, frame.visibility.faces, frame.samples
        ).detach()
        size = None if len(texture.sizes) == 1 else frame._footprint(texture, corner_uv, corners)
        level = texture._level(at, size)
        repeat = (texture.wrap[0] == "repeat", texture.wrap[1] == "repeat")
        taps = list(
            reference_textures.taps(
                at[:count].double(), level[:count].double(), texture.sizes, repeat
            )
        )
        taps = taps[: 4 if len(texture.sizes) == 1 else 8]
        texel, weight, *along = (
            np.stack([as_array64(part) for part in parts], 1) for parts in zip(*taps, strict=True)
        )
        colours = as_array64(texture.texels)[texel]
        sums = [np.einsum("nk,nkc->nc", part, colours) for part in (weight, *along)]
        return _Tapped(texel, weight, sums[0], np.stack(sums[1:], -1))


def _corner_derivatives(
    table: Float[Array, "R C"], rows: Int[Array, "N 3"]
) -> Float[Array, "C 3 N"]:
    """The values of a table at the samples' corners, which are the derivatives of values to
    barycentric coordinates.
    """
    return np.ascontiguousarray(table[rows].transpose(2, 1, 0))


def _still(frame: Frame, values: Tensor, background: Any) -> Tensor | None:
    """The image of values at samples, where the thesis' filter needs it."""
    return frame.compose(values, background).detach() if frame.mode == "filter" else None


def _no_cuts(frame: Frame) -> Csr | None:
    """Of what does not depend on vertices' values."""
    if frame.clipped is None:
        return None
    return sparse.csr_array((frame.height * frame.width, len(frame.clipped.cut_fraction)))
