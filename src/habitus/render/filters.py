"""The thesis' derivative of images to positions: differences of neighbouring pixels (T 4.4.3).

A pixel changes by minus the image's gradient times the motion of the surface that it shows.
Gradients come from kernels that do not reach across occlusion boundaries: 1/2 [-1, 0, 1] inside;
[0, -1, 1] and [-1, 1, 0] with a boundary to the left and to the right; 0 between two. A pixel on a
boundary (one or many) takes 1/2 [-1, 0, 1] and moves with the edge in it.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from habitus.render.triangles import Visibility


def filter_derivative(
    image: Float[Tensor, "N C"], boundary: Bool[Tensor, "H W"], motion: Float[Tensor, "N 2"]
) -> Float[Tensor, "N C"]:
    """The same image (H W, C) with derivatives to the screen's positions; its own to values stay.

    motion: as `surface_motion` gives it.
    """
    still = image.detach().unflatten(0, boundary.shape)
    across = differences(still, boundary, 1).flatten(0, 1) * motion[:, :1]
    down = differences(still, boundary, 0).flatten(0, 1) * motion[:, 1:]
    return image - across - down


def differences(
    image: Float[Tensor, "H W C"], boundary: Bool[Tensor, "H W"], axis: int
) -> Float[Tensor, "H W C"]:
    """Derivatives of an image along an axis (0 down, 1 across) by the thesis' kernels.

    The image's border counts as a boundary beyond it; there, a pixel on a boundary takes its own
    value for the next.
    """
    count = image.shape[axis]
    before = image.roll(1, axis)
    after = image.roll(-1, axis)
    first = torch.arange(count, device=image.device) == 0
    last = first.flip(0)
    shape = (-1, 1) if axis == 0 else (1, -1)
    first = first.view(shape)
    last = last.view(shape)
    stop_before = boundary.roll(1, axis) | first
    stop_after = boundary.roll(-1, axis) | last
    before = torch.where((first | stop_before & ~boundary)[..., None], image, before)
    after = torch.where((last | stop_after & ~boundary)[..., None], image, after)
    halves = torch.where(boundary | ~(stop_before | stop_after), 0.5, 1.0)
    derivatives = (after - before) * halves[..., None]
    return torch.where(derivatives.isfinite(), derivatives, 0.0)


def surface_motion(
    screen: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    visibility: Visibility,
    samples: Float[Tensor, "K 3"],
    boundary: Bool[Tensor, "H W"],
) -> Float[Tensor, "N 2"]:
    """For each pixel (H W) a zero that moves as the surface seen there does, or as the edge that
    crosses it.
    """
    steps = screen[:, :2] - screen[:, :2].detach()
    pixels = visibility.pixels
    corners = faces[visibility.faces[: len(pixels)]]
    coordinates = samples[: len(pixels)] * screen.detach()[corners, 2]
    flat = coordinates / coordinates.sum(-1, keepdim=True)
    motion = steps.new_zeros(boundary.numel(), 2)
    motion = motion.index_copy(0, pixels, (flat[..., None] * steps[corners]).sum(1))
    fragments = visibility.fragments
    if fragments is None or not len(fragments.pixel):
        return motion
    middle = ((fragments.start + fragments.end) / 2).to(steps.dtype)[:, None]
    lengths = (~fragments.seam * (fragments.end - fragments.start)).to(
        steps.dtype
    ) * torch.linalg.norm(
        screen.detach()[fragments.head, :2] - screen.detach()[fragments.tail, :2], dim=-1
    )
    along = lengths[:, None] * (
        (1 - middle) * steps[fragments.tail] + middle * steps[fragments.head]
    )
    total = steps.new_zeros(len(motion)).index_add(0, fragments.pixel, lengths)
    edges = (
        torch.zeros_like(motion).index_add(0, fragments.pixel, along)
        / total.clamp(min=1e-30)[:, None]
    )
    return torch.where(boundary.flatten()[:, None], edges, motion)
