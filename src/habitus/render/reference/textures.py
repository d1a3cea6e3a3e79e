"""Reference of the texture kernels in plain torch, on any device, and the derivatives of samples.

A sample is a sum of eight texels by weights (`taps`): two levels, two rows, two columns.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

Sizes = tuple[tuple[int, int], ...]
"""Height and width of each level of a texture."""


class Tap(NamedTuple):
    """One of the texels under each of N samples: its number, its weight, and that weight's
    derivatives to u and v.
    """

    texel: Int[Tensor, " N"]
    weight: Float[Tensor, " N"]
    along_u: Float[Tensor, " N"]
    along_v: Float[Tensor, " N"]


def sample(
    texels: Float[Tensor, "T C"],
    uv: Float[Tensor, "N 2"],
    level: Float[Tensor, " N"],
    sizes: Sizes,
    repeat: tuple[bool, bool],
) -> Float[Tensor, "N C"]:
    """Trilinear samples at `uv` and levels from 0 to L - 1; automatic differentiation goes
    through.
    """
    return sum_taps(
        tap.weight[:, None] * texels[tap.texel] for tap in taps(uv, level, sizes, repeat)
    )


def sample_jvp(
    texels: Float[Tensor, "T C"],
    uv: Float[Tensor, "N 2"],
    level: Float[Tensor, " N"],
    sizes: Sizes,
    repeat: tuple[bool, bool],
    texel_tangent: Float[Tensor, "T C"] | None,
    uv_tangent: Float[Tensor, "N 2"] | None,
) -> Float[Tensor, "N C"]:
    """The derivative of samples along tangents of texels and uv (JVP); None for what is
    constant.
    """
    sampled = list(taps(uv, level, sizes, repeat))
    total = torch.zeros_like(texels[:1])
    if texel_tangent is not None:
        total = total + sum_taps(tap.weight[:, None] * texel_tangent[tap.texel] for tap in sampled)
    if uv_tangent is not None:
        along_u = sum_taps(tap.along_u[:, None] * texels[tap.texel] for tap in sampled)
        along_v = sum_taps(tap.along_v[:, None] * texels[tap.texel] for tap in sampled)
        total = total + along_u * uv_tangent[:, :1] + along_v * uv_tangent[:, 1:]
    return total


def taps(
    uv: Float[Tensor, "N 2"], level: Float[Tensor, " N"], sizes: Sizes, repeat: tuple[bool, bool]
) -> Iterator[Tap]:
    """The eight texels under each sample. The level is held fixed."""
    begins = torch.tensor(table(sizes), device=uv.device)
    finest = level.detach().floor().long()
    share = level.detach() - finest
    for number, weight in ((finest, 1 - share), (finest + 1, share)):
        start, height, width = begins[number.clamp(max=len(sizes) - 1)].unbind(-1)
        left, right, x = neighbours(uv[:, 0], width, repeat[0])
        top, bottom, y = neighbours(1 - uv[:, 1], height, repeat[1])
        for row, by_row, row_derivative in ((top, 1 - y, height), (bottom, y, -height)):
            for column, by_column, column_derivative in ((left, 1 - x, -width), (right, x, width)):
                along_u = weight * by_row * column_derivative
                along_v = weight * row_derivative * by_column
                yield Tap(
                    start + row * width + column, weight * by_row * by_column, along_u, along_v
                )


def neighbours(
    coordinate: Float[Tensor, " N"], size: Int[Tensor, " N"], repeat: bool
) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"], Float[Tensor, " N"]]:
    """The texels beside a coordinate (1 is the whole length), and how far it lies from one centre
    to the next.
    """
    if repeat:
        coordinate = coordinate - coordinate.detach().floor()
    x = coordinate * size - 0.5
    lower = x.detach().floor()
    first = lower.nan_to_num().clamp(min=-1).minimum(size).long()
    second = first + 1
    zero = torch.zeros_like(size)
    if repeat:
        return first % size, second % size, x - lower
    return first.clamp(min=zero, max=size - 1), second.clamp(min=zero, max=size - 1), x - lower


def table(sizes: Sizes) -> list[tuple[int, int, int]]:
    """Of each level: where its texels begin, its height, its width."""
    rows = []
    start = 0
    for height, width in sizes:
        rows.append((start, height, width))
        start += height * width
    return rows


def sum_taps(terms: Iterator[Tensor]) -> Tensor:
    """The sum, one term after another."""
    total = next(terms)
    for term in terms:
        total = total + term
    return total
