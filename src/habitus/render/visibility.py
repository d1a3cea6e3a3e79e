"""What is where on the screen: the nearest face at each pixel, the edges that jump, and where
images take their values.

Nothing here is differentiable: these are the choices that the differentiable operators build on.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from habitus.kernels.threads import run_chunks
from habitus.render.kernels import images as image_kernels
from habitus.render.transforms import outside


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


@dataclass(frozen=True, eq=False)
class Visibility:
    """What is where on the screen: the nearest face at each pixel, -1 for none, and where images
    jump, if asked for.

    Samples, where images take their values, are listed when first wanted: the centres of `pixels`,
    those that show a face, then points beside fragments; `inner` and `outer` are the rows of the
    samples on the two sides of each fragment, -1 where the background shows. inverse: 1 / depth at
    the centres of pixels that show a face, where it is at hand. exact: whether fragments hold the
    areas of all faces in a pixel; then slivers count in full, as each counts for its area.
    """

    ids: Int[Tensor, "H W"]
    fragments: EdgeFragments | None
    inverse: Float[Tensor, "H W"] | None = None
    exact: bool = False

    def to(self, device: torch.device) -> "Visibility":
        """The same on another device."""
        fragments = self.fragments
        inverse = self.inverse
        if fragments is not None:
            fragments = EdgeFragments(*(field.to(device) for field in vars(fragments).values()))
        return Visibility(
            self.ids.to(device),
            fragments,
            None if inverse is None else inverse.to(device),
            self.exact,
        )

    @cached_property
    def _listed(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return outside(lambda ids: _list_samples(ids, self.fragments), self.ids)

    @property
    def pixels(self) -> Int[Tensor, " P"]:
        """The numbers (row * width + column) of pixels that show a face, ascending."""
        return self._listed[0]

    @property
    def faces(self) -> Int[Tensor, " N"]:
        """The face of each sample."""
        return self._listed[1]

    @property
    def points(self) -> Float[Tensor, "N 2"]:
        """The position (u, v) of each sample in pixels."""
        return self._listed[2]

    @property
    def inner(self) -> Int[Tensor, " S"]:
        """The sample on the inside of each fragment."""
        return self._listed[3]

    @property
    def outer(self) -> Int[Tensor, " S"]:
        """The sample on the outside of each fragment."""
        return self._listed[4]

    def without_fragments(self) -> "Visibility":
        """The same for images that are values at pixel centres."""
        return self if self.fragments is None else Visibility(self.ids, None, self.inverse)


def _list_samples(
    ids: Tensor, fragments: EdgeFragments | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The samples of pixels, and behind them those beside fragments; see `Visibility`."""
    if ids.device.type == "cpu":
        pixels, faces, points = (torch.from_numpy(array) for array in list_pixels(ids.numpy()))
    else:
        pixels, faces, points = list_pixels_reference(ids)
    if fragments is None:
        return pixels, faces, points, pixels[:0], pixels[:0]
    beside = torch.cat([fragments.inner_face, fragments.outer_face])
    shows = beside >= 0
    inner, outer = torch.where(shows, len(pixels) - 1 + torch.cumsum(shows, 0), -1).view(2, -1)
    more = torch.cat([fragments.inner_point, fragments.outer_point])[shows]
    return pixels, torch.cat([faces, beside[shows]]), torch.cat([points, more]), inner, outer


def list_pixels(ids: Int[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixels that show a face, row by row: numbers, faces, centres."""
    counts = np.empty(len(ids), np.int64)
    run_chunks(
        lambda _, begin, end: image_kernels.count_pixels(ids, begin, end, counts),
        len(ids),
        least=64,
    )
    offset = np.concatenate([[0], np.cumsum(counts)])
    pixels = np.empty(offset[-1], np.int64)
    faces = np.empty(offset[-1], np.int64)
    points = np.empty((offset[-1], 2))

    def work(_: int, begin: int, end: int) -> None:
        image_kernels.list_pixels(ids, offset, begin, end, pixels, faces, points)

    run_chunks(work, len(ids), least=64)
    return pixels, faces, points


def list_pixels_reference(
    ids: Int[Tensor, "H W"],
) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"], Float[Tensor, "P 2"]]:
    """Reference of `list_pixels`, on any device: numbers, faces and centres of pixels that show a
    face, row by row.
    """
    shown = (ids.flatten() >= 0).nonzero()[:, 0]
    return shown, ids.flatten()[shown].long(), pixel_centres(shown, ids.shape[1])


def pixel_centres(pixel: Int[Tensor, " K"], width: int) -> Float[Tensor, "K 2"]:
    """The centres (u, v) of pixels given by row * width + column."""
    return torch.stack([pixel % width, pixel // width], -1).double() + 0.5
