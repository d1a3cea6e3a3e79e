"""Where an image jumps: the visible parts of edges, cut at the pixels' borders."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Segments:
    """S parts of edges, each within one pixel, with what the image jumps by there.

    ``image[pixel] += weight * (value outside - value inside)`` turns values at pixel centres into exact averages over
    pixels, of colours that are constant on each side. All are decisions: none carries a derivative.
    """

    pixel: Int[Tensor, " S"]
    """row * width + column."""
    tail: Int[Tensor, " S"]
    """The vertex from where the edge runs, in the order of the inside face's corners."""
    head: Int[Tensor, " S"]
    """The vertex to where it runs."""
    inside: Int[Tensor, " S"]
    """The face whose border the edge is."""
    outside: Int[Tensor, " S"]
    """The face that shows on the other side; -1 where the background does."""
    start: Float[Tensor, " S"]
    """Where the part begins: 0 at the tail, 1 at the head, linear on the screen."""
    end: Float[Tensor, " S"]
    """Where it ends."""
    outward: Float[Tensor, " S"]
    """1 or -1: with (du, dv) from tail to head, outward * (dv, -du) points to the outside."""
    weight: Float[Tensor, " S"]
    """The part's area of the pixel's square, signed: positive where the centre lies on the inside."""
    point: Float[Tensor, "S 2"]
    """The part's middle (u, v)."""
