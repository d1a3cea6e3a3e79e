"""The clear twin of the texture kernels, in plain torch on any device; it also says what a derivative is.

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
    """One of the texels under each of N samples: its number, its weight, and that weight's derivatives to u and v."""

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
    """Trilinear samples at places `uv` and levels from 0 to L - 1; automatic differentiation goes through."""
    return sum_taps(tap.weight[:, None] * texels[tap.texel] for tap in taps(uv, level, sizes, repeat))


def step(
    texels: Float[Tensor, "T C"],
    uv: Float[Tensor, "N 2"],
    level: Float[Tensor, " N"],
    sizes: Sizes,
    repeat: tuple[bool, bool],
    texel_step: Float[Tensor, "T C"] | None,
    uv_step: Float[Tensor, "N 2"] | None,
) -> Float[Tensor, "N C"]:
    """How samples change as texels and places do, to first order; None for what stands still."""
    found, total = list(taps(uv, level, sizes, repeat)), torch.zeros_like(texels[:1])
    if texel_step is not None:
        total = total + sum_taps(tap.weight[:, None] * texel_step[tap.texel] for tap in found)
    if uv_step is not None:
        along_u = sum_taps(tap.along_u[:, None] * texels[tap.texel] for tap in found)
        along_v = sum_taps(tap.along_v[:, None] * texels[tap.texel] for tap in found)
        total = total + along_u * uv_step[:, :1] + along_v * uv_step[:, 1:]
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
        for row, by_row, row_slope in ((top, 1 - y, height), (bottom, y, -height)):
            for column, by_column, column_slope in ((left, 1 - x, -width), (right, x, width)):
                along_u, along_v = weight * by_row * column_slope, weight * row_slope * by_column
                yield Tap(start + row * width + column, weight * by_row * by_column, along_u, along_v)


def neighbours(
    place: Float[Tensor, " N"], size: Int[Tensor, " N"], repeat: bool
) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"], Float[Tensor, " N"]]:
    """The two texels beside a place (1 is the whole length), and how far it lies from one's centre to the next's."""
    if repeat:
        place = place - place.detach().floor()
    x = place * size - 0.5
    lower = x.detach().floor()
    first = lower.nan_to_num().clamp(min=-1).minimum(size).long()
    second, zero = first + 1, torch.zeros_like(size)
    if repeat:
        return first % size, second % size, x - lower
    return first.clamp(min=zero, max=size - 1), second.clamp(min=zero, max=size - 1), x - lower


def table(sizes: Sizes) -> list[tuple[int, int, int]]:
    """Of each level: where its texels begin, its height, its width."""
    rows, start = [], 0
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
