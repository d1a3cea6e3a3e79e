"""Where an image jumps: the visible fragments of edges, cut at the pixels' borders."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class EdgeFragments:
    """S edge fragments, each within one pixel and sorted by pixel, and what an image jumps by
    there.

    ``image[pixel] += weight * (value at outer_point - value at inner_point)`` turns values at pixel
    centres into averages over pixels (`render/README.md`). All are decisions: none carries a
    derivative.
    """

    pixel: Int[Tensor, " S"]
    """row * width + column."""
    tail: Int[Tensor, " S"]
    """The vertex from where the edge runs, in the order of its face's corners."""
    head: Int[Tensor, " S"]
    """The vertex to where it runs."""
    face: Int[Tensor, " S"]
    """The face whose border the edge is: it lies inside."""
    seam: Bool[Tensor, " S"]
    """Whether the surface goes on outside: vertices are doubled there, and values may jump, but
    nothing is in front.
    """
    start: Float[Tensor, " S"]
    """Where the fragment begins: 0 at the tail, 1 at the head, linear on the screen."""
    end: Float[Tensor, " S"]
    """Where it ends."""
    outward: Float[Tensor, " S"]
    """1 or -1: with (du, dv) from tail to head, outward * (dv, -du) points to the outside."""
    weight: Float[Tensor, " S"]
    """The area of the pixel that the fragment cuts off, as seen from the centre; negative where
    that lies outside.
    """
    inner_face: Int[Tensor, " S"]
    """The face that shows at ``inner_point``; -1 where the background does."""
    outer_face: Int[Tensor, " S"]
    """The same at ``outer_point``."""
    inner_point: Float[Tensor, "S 2"]
    """A point (u, v) of the pixel on the inside, away from the edge."""
    outer_point: Float[Tensor, "S 2"]
    """The same on the outside."""
