"""What a fit may compare instead of pixels (T 4.5): pyramids, edges, moments, masked and robust
differences.

Images are (*batch, H, W, C), row 0 on top; give a depth image or a silhouette one channel
(``image[..., None]``). Pixel (row r, column c) has its centre at (u, v) = (c + 0.5, r + 0.5). All
is plain torch: differentiable, on any device.
"""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Literal, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from habitus.errors import HabitusError

Levels: TypeAlias = tuple[Tensor, ...]
Normalization: TypeAlias = Literal["SSE", "size"] | None


def gaussian_pyramid(
    image: Float[Tensor, "*batch H W C"],
    num_levels: int = 3,
    normalization: Normalization = None,
    reference: Float[Tensor, "*#batch H W C"] | None = None,
) -> Levels:
    """The image and ``num_levels`` smaller ones, each blurred and halved (Burt and Adelson 1983); a
    linear function.

    The blur is (1, 4, 6, 4, 1)/16 along both axes, mirrored at the border; of its pixels 0, 2, 4,
    ... stay, so that H becomes (H + 1) // 2, and 1 stays 1.

    ``normalization`` weighs the levels, as OpenDR does for a pyramid of a difference image: None
    leaves them; "size" divides each by its number of values; "SSE" divides each by the root of the
    sum of squares of that level of ``reference``, so that all levels count alike where the image is
    the reference. The reference is taken as constant: OpenDR's is the difference at the start of a
    fit; the observed image is another good choice. A level of it that is zero everywhere divides
    nothing. (OpenDR blurs with 3 x 3 pixels and loses the border.)
    """
    _check(image, num_levels)
    levels = [image]
    for _ in range(num_levels):
        levels.append(_halved(_halved(levels[-1], -2), -3))
    return _normalized(gaussian_pyramid, levels, normalization, reference)


def laplacian_pyramid(
    image: Float[Tensor, "*batch H W C"],
    num_levels: int = 3,
    normalization: Normalization = None,
    reference: Float[Tensor, "*#batch H W C"] | None = None,
) -> Levels:
    """What each level of the Gaussian pyramid has more than the next one enlarged, and last its
    smallest level.

    ``num_levels`` bands and the rest, ``num_levels`` + 1 images; ``normalization`` as in
    ``gaussian_pyramid``. Without it ``from_laplacian_pyramid`` gives the image back.
    """
    levels = gaussian_pyramid(image, num_levels)
    bands = [fine - _enlarged(coarse, fine) for fine, coarse in pairwise(levels)]
    return _normalized(laplacian_pyramid, [*bands, levels[-1]], normalization, reference)


def from_laplacian_pyramid(levels: Levels) -> Float[Tensor, "*batch H W C"]:
    """The image of a Laplacian pyramid without normalisation."""
    image = levels[-1]
    for band in reversed(levels[:-1]):
        image = band + _enlarged(image, band)
    return image


def as_vector(images: Iterable[Float[Tensor, "*batch _ _ _"]]) -> Float[Tensor, "*batch N"]:
    """All values of all images (levels of a pyramid, edges) one after the other: a residual."""
    return torch.cat([image.flatten(-3) for image in images], -1)


def edges(
    image: Float[Tensor, "*batch H W C"],
) -> tuple[Float[Tensor, "*batch H W-1 C"], Float[Tensor, "*batch H-1 W C"]]:
    """Differences of neighbours: right less left, and lower less upper (T figure 4-5)."""
    _check(image)
    return image[..., 1:, :] - image[..., :-1, :], image[..., 1:, :, :] - image[..., :-1, :, :]


def moments(image: Float[Tensor, "*batch H W C"]) -> Float[Tensor, "*batch 6 C"]:
    """m00, m10, m01, m20, m11, m02 of each channel: sums of value u^p v^q over pixel centres, in
    pixels.
    """
    _check(image)
    return _moments(image, *_centres(image))


def central_moments(image: Float[Tensor, "*batch H W C"]) -> Float[Tensor, "*batch 6 C"]:
    """m00, the centroid's u and v, and mu20, mu11, mu02: sums of value (u - u0)^p (v - v0)^q, in
    pixels.

    A channel whose sum is exactly zero has no centroid: all six are 0, with finite derivatives.
    """
    _check(image)
    u, v = _centres(image)
    m00, m10, m01 = _moments(image, u, v)[..., :3, :].unbind(-2)
    some = m00 != 0
    u0, v0 = (m.where(some, 0.0) / m00.where(some, 1.0) for m in (m10, m01))
    second = _moments(image, u - u0[..., None, :], v - v0[..., None, :])[..., 3:, :]
    return torch.cat([torch.stack([m00, u0, v0], -2), second.where(some[..., None, :], 0.0)], -2)


def normalized_moments(image: Float[Tensor, "*batch H W C"]) -> Float[Tensor, "*batch 3 C"]:
    """eta20, eta11, eta02 = mu / m00^2, unchanged when a shape moves or (up to pixels) grows; 0
    where m00 is 0.
    """
    central = central_moments(image)
    m00 = central[..., :1, :]
    return central[..., 3:, :] / m00.where(m00 != 0, 1.0) ** 2


def masked_difference(
    image: Float[Tensor, "*#batch H W C"],
    observed: Float[Tensor, "*#batch H W C"],
    mask: Bool[Tensor, "*#batch H W"],
) -> Float[Tensor, "*batch H W C"]:
    """``image`` - ``observed`` where ``mask`` is true, else 0, even where an image is NaN or
    infinite.
    """
    _check(image)
    _check(observed)
    if (
        mask.dtype != torch.bool
        or mask.ndim < 2
        or not (mask.shape[-2:] == image.shape[-3:-1] == observed.shape[-3:-1])
    ):
        raise HabitusError(
            f"mask is {mask.dtype} {tuple(mask.shape)}, images {tuple(image.shape)} and "
            f"{tuple(observed.shape)}; "
            "expected a bool mask (*batch, H, W) and images (*batch, H, W, C) of one size"
        )
    return (image - observed).where(mask[..., None], 0.0)


def geman_mcclure(
    difference: Float[Tensor, "*any"], scale: float | Tensor
) -> Float[Tensor, "*any"]:
    """A residual whose square is Geman and McClure's loss s^2 d^2 / (s^2 + d^2) of each value d,
    with s the scale.
    """
    _check_scale(scale)
    return difference * (1 + (difference / scale) ** 2).rsqrt()


def huber(difference: Float[Tensor, "*any"], scale: float | Tensor) -> Float[Tensor, "*any"]:
    """A residual whose square is Huber's loss: d^2 up to the scale s, 2 s |d| - s^2 beyond."""
    _check_scale(scale)
    share = scale / difference.abs().clamp(min=scale)
    return difference * (share * (2 - share)).sqrt()


def power_law(
    difference: Float[Tensor, "*any"], scale: float | Tensor, power: float
) -> Float[Tensor, "*any"]:
    """A residual whose square grows as |d|^power beyond the scale s: the robust norm of T equation
    4.5, made smooth.

    The loss is (2 s^2 / power) ((1 + d^2 / s^2)^(power / 2) - 1): d^2 near zero, and everywhere for
    power 2. The thesis goes from 2 to 1 over the course of a fit.
    """
    _check_scale(scale)
    if not 0.0 < power <= 2.0:
        raise HabitusError(f"power is {power!r}; expected a number above 0 and at most 2")
    squared = (difference / scale) ** 2
    some = squared > torch.finfo(squared.dtype).tiny
    squared = squared.where(some, 1.0)
    ratio = torch.expm1(power / 2 * torch.log1p(squared)) / squared * (2 / power)
    return difference * ratio.sqrt().where(some, 1.0)


def _halved(image: Tensor, axis: int) -> Tensor:
    """Blurred by (1, 4, 6, 4, 1)/16 along an axis, then every other pixel; mirrored about the
    outermost pixels.
    """
    size = image.shape[axis]
    new = (size + 1) // 2
    period = max(2 * (size - 1), 1)
    before, after = (
        [min(k % period, -k % period) for k in range(*ends)]
        for ends in ((-2, 0), (size, 2 * new + 2))
    )
    even, odd = _lengthened(image, axis, before, after).unflatten(axis, (new + 2, 2)).unbind(axis)
    a, c, e = (even.narrow(axis, k, new) for k in range(3))
    b, d = (odd.narrow(axis, k, new) for k in range(2))
    return (a + e) * 0.0625 + (b + d) * 0.25 + c * 0.375


def _enlarged(image: Tensor, like: Tensor) -> Tensor:
    """As large as ``like``: zeros between the pixels, blurred by (1, 4, 6, 4, 1)/8 along both
    axes.
    """
    for axis in (-2, -3):
        size = image.shape[axis]
        new = like.shape[axis]
        before = min(1, size - 1)
        after = size - 1 if new % 2 == 0 else max(size - 2, 0)
        wide = _lengthened(image, axis, [before], [after])
        a, b, c = (wide.narrow(axis, k, size) for k in range(3))
        even = (a + c) * 0.125 + b * 0.75
        odd = (b + c) * 0.5
        image = torch.stack([even, odd], axis).flatten(axis - 1, axis).narrow(axis, 0, new)
    return image


def _lengthened(image: Tensor, axis: int, before: list[int], after: list[int]) -> Tensor:
    """Copies of the pixels at the places ``before`` put in front along an axis, and of those at
    ``after`` behind.
    """
    head, tail = (
        image.index_select(axis, torch.tensor(k, device=image.device)) for k in (before, after)
    )
    return torch.cat([head, image, tail], axis)


def _normalized(
    pyramid, levels: list[Tensor], normalization: Normalization, reference: Tensor | None
) -> Levels:
    if normalization is None:
        return tuple(levels)
    if normalization == "size":
        return tuple(level / max(1, math.prod(level.shape[-3:])) for level in levels)
    if normalization != "SSE":
        raise HabitusError(f"normalization is {normalization!r}; expected 'SSE', 'size' or None")
    if reference is None or reference.shape[-3:] != levels[0].shape[-3:]:
        shape = None if reference is None else tuple(reference.shape)
        raise HabitusError(
            f"reference is {shape}; normalization 'SSE' needs an image "
            f"{tuple(levels[0].shape[-3:])}, such as the "
            "observed one or the difference at the start"
        )
    with torch.no_grad():
        norms = [
            level.square().sum((-3, -2, -1), keepdim=True).sqrt()
            for level in pyramid(reference, len(levels) - 1)
        ]
    return tuple(
        level / norm.where(norm > 0, 1.0) for level, norm in zip(levels, norms, strict=True)
    )


def _centres(image: Tensor) -> tuple[Float[Tensor, "W 1"], Float[Tensor, "H 1"]]:
    """u of the columns' and v of the rows' centres."""
    height, width = image.shape[-3:-1]
    u, v = (
        torch.arange(size, dtype=image.dtype, device=image.device)[:, None] + 0.5
        for size in (width, height)
    )
    return u, v


def _moments(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Six moments (*batch, 6, C) with ``u`` (*batch, W, 1 or C) and ``v`` (*batch, H, 1 or C)."""
    columns = image.sum(-3)
    rows = image.sum(-2)
    turned = (image * u[..., None, :, :]).sum(-2)
    sums = (columns, columns * u, rows * v, columns * u * u, turned * v, rows * v * v)
    return torch.stack([values.sum(-2) for values in sums], -2)


def _check(image: Tensor, num_levels: int = 0) -> None:
    if image.ndim < 3 or 0 in image.shape[-3:-1]:
        raise HabitusError(
            f"image is {tuple(image.shape)}; expected (*batch, H, W, C); for one channel take "
            "[..., None]"
        )
    if not image.is_floating_point():
        raise HabitusError(
            f"image is {image.dtype}; expected floating numbers, such as image.float() / 255"
        )
    if not isinstance(num_levels, int) or num_levels < 0:
        raise HabitusError(f"num_levels is {num_levels!r}; expected a whole number, 0 or more")


def _check_scale(scale: float | Tensor) -> None:
    if not isinstance(scale, Tensor) and not 0.0 < scale < math.inf:
        raise HabitusError(
            f"scale is {scale!r}; expected a number greater than 0, in the units of the difference"
        )
