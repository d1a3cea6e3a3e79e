"""Textures: images laid on surfaces, mipmapped, with derivatives to their texels too (T 4.3, future
work there).

Texture coordinates (u, v) are (0, 0) at the image's bottom left corner and (1, 1) at its top right
one; row 0 is on top and centres of texels lie at half-integers. Between centres values are
bilinear; between levels, each half as large as the one before, they are linear in the level
(trilinear), which the footprint of a pixel chooses (Williams 1983).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from habitus.errors import HabitusError
from habitus.kernels.threads import num_threads, run_chunks
from habitus.render.kernels import textures as texture_kernels
from habitus.render.reference import textures as reference_textures
from habitus.render.reference.textures import Sizes
from habitus.render.transforms import Operator, outside

WRAPS = ("repeat", "clamp")
SampleArrays = tuple[np.ndarray, tuple[bool, bool], np.ndarray, np.ndarray]
"""What kernels need to know of N samples: the table of levels, which axes repeat, uv (N, 2), level
(N,).
"""


@dataclass(frozen=True, eq=False)
class Texture:
    """An image and its smaller copies, one behind another: texels (T, C), sizes (height, width) of
    each level.

    wrap: what lies beyond the image along u and along v, "repeat" (the image again) or "clamp" (its
    border's texels).
    """

    texels: Float[Tensor, "T C"]
    sizes: Sizes
    wrap: tuple[str, str]

    @classmethod
    def of(
        cls,
        image: Float[Tensor, "h w C"] | np.ndarray,
        mipmaps: bool = True,
        wrap: Sequence[str] = ("repeat", "clamp"),
    ) -> Self:
        """A texture of an image (h, w, C), float32 or float64, with all smaller levels down to one
        texel if `mipmaps`.

        Derivatives go through to the image. HabitusError: no pixels, texels not finite, wrong rank,
        type or wrap.
        """
        level = torch.as_tensor(image)
        levels = [level]
        while mipmaps and level.ndim == 3 and max(level.shape[:2]) > 1:
            level = halve(halve(level, 0), 1)
            levels.append(level)
        return cls.from_levels(levels, wrap)

    @classmethod
    def from_levels(
        cls, levels: Sequence[Float[Tensor, "_ _ C"]], wrap: Sequence[str] = ("repeat", "clamp")
    ) -> Self:
        """A texture of levels made elsewhere, the largest first, each half (rounded down, at least
        1) of the last.
        """
        if not levels:
            raise HabitusError(
                "texture has no levels; expected at least one image (height, width, channels)"
            )
        for level in levels:
            _check_level(level, levels[0])
        sizes = tuple((level.shape[0], level.shape[1]) for level in levels)
        for larger, smaller in pairwise(sizes):
            expected = max(larger[0] // 2, 1), max(larger[1] // 2, 1)
            if smaller != expected:
                raise HabitusError(
                    f"texture level of {smaller} texels after one of {larger}; expected {expected}"
                )
        if len(wrap) != 2 or not all(mode in WRAPS for mode in wrap):
            raise HabitusError(
                f"texture wrap is {wrap!r}; expected one of {WRAPS} for u and one for v"
            )
        flat = [level.flatten(0, 1) for level in levels]
        return cls(flat[0] if len(flat) == 1 else torch.cat(flat), sizes, (wrap[0], wrap[1]))

    @property
    def levels(self) -> tuple[Float[Tensor, "h w C"], ...]:
        """The images, the largest first, as views of the texels."""
        parts = self.texels.split([height * width for height, width in self.sizes])
        return tuple(part.unflatten(0, size) for part, size in zip(parts, self.sizes, strict=True))

    def to(self, *target: Any) -> "Texture":
        """The same texture on another device or with other floating-point numbers, as
        `Tensor.to`.
        """
        return Texture(self.texels.to(*target), self.sizes, self.wrap)

    def sample(
        self, uv: Float[Tensor, "N 2"], footprint: Float[Tensor, " N"] | None = None
    ) -> Float[Tensor, "N C"]:
        """Values at texture coordinates `uv`: bilinear, or trilinear where a `footprint` is given.

        footprint: how many texels of the largest level a step of one pixel covers (see
        `footprint`); the level is its base-2 logarithm, from 0 up to the last. Derivatives go to
        texels and uv, the level being held fixed. A uv that is not finite gives NaN. HabitusError:
        uv or footprint of another shape, type or device.
        """
        _check_uv(uv, footprint, self.texels)
        level = self._level(uv, footprint)
        repeat = self.wrap[0] == "repeat", self.wrap[1] == "repeat"
        arguments = self.texels, uv.to(self.texels.dtype), level, self.sizes, repeat
        on_cpu = self.texels.device.type == "cpu"
        values = _Sample.apply(*arguments) if on_cpu else reference_textures.sample(*arguments)
        return values.to(torch.promote_types(uv.dtype, self.texels.dtype))

    def _level(self, uv: Tensor, footprint: Tensor | None) -> Tensor:
        if footprint is None or len(self.sizes) == 1:
            return torch.zeros(len(uv), dtype=self.texels.dtype, device=uv.device)
        level = footprint.detach().to(self.texels.dtype).clamp(min=1.0).log2()
        return level.nan_to_num(nan=0.0).clamp(max=len(self.sizes) - 1.0)


def footprint(
    uv_dx: Float[Tensor, "N 2"], uv_dy: Float[Tensor, "N 2"], texture: Texture
) -> Float[Tensor, " N"]:
    """How many texels of the largest level a step of a pixel covers: the longer of the steps along
    x and along y.

    uv_dx, uv_dy: how texture coordinates change from a pixel to its right, and to its lower,
    neighbour. It only chooses a level, and has no derivative.
    """
    height, width = texture.sizes[0]
    size = uv_dx.new_tensor([width, height])
    return torch.maximum(
        *(torch.linalg.vector_norm(uv_step.detach() * size, dim=-1) for uv_step in (uv_dx, uv_dy))
    )


def halve(image: Tensor, axis: int) -> Tensor:
    """An image of half the length along an axis, rounded down but at least 1: means over equal
    parts of that length.

    Where the length is odd a part covers two texels and shares a third (Guthe and Heckbert 2005):
    the mean of all values stays.
    """
    length = image.shape[axis]
    half = length // 2
    if half == 0:
        return image
    first, second = image.narrow(axis, 0, 2 * half).unflatten(axis, (half, 2)).unbind(axis + 1)
    if length % 2 == 0:
        return (first + second) / 2
    third = image.narrow(axis, 1, 2 * half).unflatten(axis, (half, 2)).select(axis + 1, 1)
    share = torch.arange(half + 1, dtype=image.dtype, device=image.device) / length
    share = share.unflatten(0, (-1,) + (1,) * (image.ndim - 1 - axis))
    return share.flip(0)[:-1] * first + (half / length) * second + share[1:] * third


class _Sample(Operator):
    """The kernels as one torch function."""

    @staticmethod
    def forward(
        texels: Tensor, uv: Tensor, level: Tensor, sizes: Sizes, repeat: tuple[bool, bool]
    ) -> Tensor:
        array, *where = (tensor.detach().contiguous().numpy() for tensor in (texels, uv, level))
        samples = (_table(sizes), repeat, where[0], where[1])
        out = np.empty((len(uv), texels.shape[1]), array.dtype)

        def work(_: int, begin: int, end: int) -> None:
            texture_kernels.sample_texels(array, *samples, begin, end, out)

        run_chunks(work, len(uv))
        return torch.from_numpy(out)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        texels, uv, level, ctx.sizes, ctx.repeat = inputs
        ctx.save_for_backward(texels, uv, level)
        ctx.save_for_forward(texels, uv, level)
        ctx.set_materialize_grads(False)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor | None) -> Any:
        if cotangent is None:
            return None, None, None, None, None

        def vjp(*tensors: Tensor) -> tuple[Tensor | None, Tensor | None]:
            texels, uv, level, cotangent = (tensor.contiguous().numpy() for tensor in tensors)
            samples = _table(ctx.sizes), ctx.repeat, uv, level
            to_texels = _texels_vjp(texels, samples, cotangent) if ctx.needs_input_grad[0] else None
            return to_texels, _uv_vjp(texels, samples, cotangent) if ctx.needs_input_grad[
                1
            ] else None

        return *outside(vjp, *ctx.saved_tensors, cotangent), None, None, None

    @staticmethod
    def jvp(ctx: Any, texel_tangent: Tensor | None, uv_tangent: Tensor | None, *_: Any) -> Tensor:
        texels, uv, level = ctx.saved_tensors
        return reference_textures.sample_jvp(
            texels, uv, level, ctx.sizes, ctx.repeat, texel_tangent, uv_tangent
        )

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise HabitusError(
            "vmap over textures or their uv is not supported: sample all uv of one at once"
        )


def _texels_vjp(texels: np.ndarray, samples: SampleArrays, cotangent: np.ndarray) -> Tensor:
    """The derivative to texels; each thread adds to rows of its own, so nothing is kept twice,
    however large it is.
    """
    out = np.zeros(texels.shape, texels.dtype)  # pages that are not touched cost nothing
    stripes = 1 << (num_threads() - 1).bit_length() if len(cotangent) > 4096 else 1

    def work(_: int, begin: int, end: int) -> None:
        texture_kernels.sample_texels_vjp(*samples, cotangent, stripes, begin, end, out)

    run_chunks(work, stripes, least=1)
    return torch.from_numpy(out)


def _uv_vjp(texels: np.ndarray, samples: SampleArrays, cotangent: np.ndarray) -> Tensor:
    out = np.empty((len(cotangent), 2), cotangent.dtype)

    def work(_: int, begin: int, end: int) -> None:
        texture_kernels.sample_uv_vjp(texels, *samples, cotangent, begin, end, out)

    run_chunks(work, len(cotangent))
    return torch.from_numpy(out)


def _table(sizes: Sizes) -> np.ndarray:
    return np.array(reference_textures.table(sizes), np.uint64)


def _check_level(level: Tensor, first: Tensor) -> None:
    shape = tuple(level.shape)
    if len(shape) != 3 or 0 in shape:
        raise HabitusError(
            f"texture image is {shape}; expected (height, width, channels), each at least 1"
        )
    if level.dtype not in (torch.float32, torch.float64):
        raise HabitusError(
            f"texture texels are {level.dtype}; expected float32 or float64 (divide bytes by 255)"
        )
    if (
        level.shape[2] != first.shape[2]
        or level.dtype != first.dtype
        or level.device != first.device
    ):
        raise HabitusError(
            f"texture level {shape} differs from the first in channels, type or device; make them "
            "equal"
        )
    if not outside(
        lambda texels: bool(texels.sum().isfinite()) or bool(texels.isfinite().all()), level
    ):
        raise HabitusError(f"texture image {shape} has texels that are not finite; fill them first")


def _check_uv(uv: Tensor, footprint: Tensor | None, texels: Tensor) -> None:
    if uv.ndim != 2 or uv.shape[1] != 2 or not uv.is_floating_point():
        raise HabitusError(
            f"texture coordinates are {tuple(uv.shape)} {uv.dtype}; expected (N, 2) "
            "floating-point numbers"
        )
    if footprint is not None and footprint.shape != uv.shape[:1]:
        raise HabitusError(
            f"footprint is {tuple(footprint.shape)}; expected one number per uv, ({len(uv)},)"
        )
    for given in (uv, footprint):
        if given is not None and given.device != texels.device:
            raise HabitusError(
                f"uv is on {given.device}, the texture on {texels.device}; move one with .to"
            )
