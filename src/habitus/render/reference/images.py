"""The renderer's reference in plain torch, which also serves tensors on another device than the
CPU.

What is where: `visible`, `edge_fragments`. What an image is then made of, differentiable:
`barycentrics`, `interpolate`, `compose`. The kernels compute the same on the CPU; tests compare the
two.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.render.reference.faces import Nearest, box_pixels, drawn_faces
from habitus.render.reference.segments import edge_fragments
from habitus.render.triangles import (
    EdgeFragments,
    Triangles,
    Visibility,
    pixel_centres,
    share_of_pixel,
)

__all__ = [
    "barycentrics",
    "compose",
    "edge_fragments",
    "fragment_weights",
    "interpolate",
    "share_of_pixel",
    "visible",
]


def visible(
    screen: Float[Tensor, "V 3"], triangles: Triangles, width: int, height: int, cull: bool = False
) -> Int[Tensor, "H W"]:
    """The nearest face at each pixel's centre, int32; -1 where there is none. `screen` holds u, v
    and depth.

    Pixel (row, column) has its centre at u = column + 0.5, v = row + 0.5. A centre exactly on an
    edge belongs to the face that has it as a left edge (the inside lies to the right) or a
    horizontal top edge (the inside lies below): the face that covers the centre once it is moved a
    little to the right and far less downwards. Of equally near faces the first wins. `drawn_faces`
    says which faces take part.
    """
    drawn = drawn_faces(screen, triangles, cull)
    nearest = Nearest(drawn, width * height)
    for n, pixel in box_pixels(drawn, width, height, 0.0):
        nearest.add(n, pixel, pixel_centres(pixel, width))
    return nearest.face().reshape(height, width).int()


def fragment_weights(screen: Float[Tensor, "V 3"], fragments: EdgeFragments) -> Float[Tensor, " S"]:
    """The fragments' weights, with the derivative of the area that moving edges sweep."""
    return fragments.weight.to(screen.dtype) + swept(
        screen.detach(), screen - screen.detach(), fragments
    )


def swept(
    screen: Float[Tensor, "V 3"], step: Float[Tensor, "V 3"], fragments: EdgeFragments
) -> Float[Tensor, " S"]:
    """How weights change as the screen moves by a small step: minus the area that the fragments
    sweep outward.
    """
    along = screen[fragments.head, :2] - screen[fragments.tail, :2]
    middle = ((fragments.start + fragments.end) / 2).to(screen.dtype)[:, None]
    scale = (fragments.outward * (fragments.end - fragments.start)).to(screen.dtype)
    moved = (1 - middle) * step[fragments.tail, :2] + middle * step[fragments.head, :2]
    return -scale * (along[:, 1] * moved[:, 0] - along[:, 0] * moved[:, 1])


def barycentrics(
    screen: Float[Tensor, "V 3"],
    corners: Int[Tensor, "N 3"],
    points: Float[Tensor, "N 2"],
    exact: bool = False,
) -> Float[Tensor, "N 3"]:
    """Perspective-correct weights of the corners of the face under each point; they add up to 1.
    Differentiable.

    Computed in float64 and returned in the screen's type: on a sliver, float32 would leave the
    face. There they hardly move with the corners on the screen, unless `exact`: `share_of_pixel`.
    """
    at = screen.index_select(0, corners.reshape(-1)).reshape(len(corners), 3, 3).double()
    held = at[..., :2].detach()
    counts = torch.ones(()) if exact else share_of_pixel(held)[:, None, None]
    away = held - points[:, None].double() + counts.to(held) * (at[..., :2] - held)
    after = away.roll(-1, 1)
    before = away.roll(-2, 1)
    share = (after[..., 0] * before[..., 1] - after[..., 1] * before[..., 0]) / at[..., 2]
    return (share / share.sum(-1, keepdim=True)).to(screen.dtype)


def interpolate(
    values: Float[Tensor, "V C"], corners: Int[Tensor, "N 3"], barycentrics: Float[Tensor, "N 3"]
) -> Float[Tensor, "N C"]:
    """Values of vertices at samples with these corners and barycentrics. Differentiable in both."""
    at = values.index_select(0, corners.reshape(-1)).reshape(len(corners), 3, -1)
    return (at * barycentrics[..., None]).sum(1)


def compose(
    values: Float[Tensor, "N C"],
    background: Float[Tensor, "K C"],
    weights: Float[Tensor, " S"],
    visibility: Visibility,
) -> Float[Tensor, "P C"]:
    """An image's pixels, row by row, from values at samples, the background (one row, or one a
    pixel) and jumps.

    The sum of `render/README.md`: each fragment adds to its pixel its weight times the jump from
    its inner to its outer sample. A jump that is not finite is left out: nothing is mixed with an
    infinitely distant background. Differentiable in all but `visibility`.
    """
    behind = background.expand(visibility.ids.numel(), -1)
    image = behind.index_copy(0, visibility.pixels, values[: len(visibility.pixels)])
    if visibility.fragments is None:
        return image
    pixel = visibility.fragments.pixel
    rows = torch.cat([values, values.new_zeros(1, values.shape[1])])
    inner, outer = (
        torch.where((row >= 0)[:, None], rows[row], behind[pixel])
        for row in (visibility.inner, visibility.outer)
    )
    jump = outer - inner
    return image.index_add(0, pixel, weights[:, None] * torch.where(jump.isfinite(), jump, 0.0))
