"""A view's colours at a level of a pyramid (T 4.6.1): what was seen, the empty room behind it, and
the camera.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from habitus.fit.rgbd.appearance import to_linear
from habitus.fit.rgbd.colour_camera import moved
from habitus.fit.rgbd.sights import Sight
from habitus.observe.camera import Camera

MARGIN = 24
"""Full-size pixels around the person that are looked at."""
BRIGHTEST = 254
"""Bytes from which a pixel is overexposed."""


@dataclass(frozen=True, eq=False)
class ColourLevel:
    """Linear colours (h, w, 3) around the person, means over ``factor`` x ``factor`` pixels: seen,
    and of the room.

    usable (h, w): 1 where no pixel is overexposed, else 0.
    """

    camera: Camera
    factor: int
    seen: Float[np.ndarray, "h w 3"]
    room: Float[np.ndarray, "h w 3"]
    usable: Float[np.ndarray, "h w"]

    @staticmethod
    def of(
        sight: Sight,
        vertices: Float[np.ndarray, "V 3"],
        shift: Float[np.ndarray, " 3"],
        factor: int,
    ) -> "ColourLevel | None":
        """The neighbourhood of a surface in a view; None without colour of the person and of the
        empty room.
        """
        if (
            sight.colour_camera is None
            or sight.view.colour is None
            or sight.view.background_colour is None
        ):
            return None
        camera = moved(sight.colour_camera, shift)
        pixels = camera.project(torch.from_numpy(vertices))[0].numpy()
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(pixels.min(0)) - MARGIN, 0, size - factor).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + MARGIN, low + factor, size).astype(int)
        across, down = (high - low) // factor * factor
        part = (slice(low[1], low[1] + down), slice(low[0], low[0] + across))
        small = camera.replace(
            width=int(across) // factor,
            height=int(down) // factor,
            focal_length=camera.focal_length / factor,
            principal_point=(camera.principal_point - torch.from_numpy(low.astype(float))) / factor,
        )
        seen, room = (
            to_linear(image[part]) for image in (sight.view.colour, sight.view.background_colour)
        )
        usable = (sight.view.colour[part].max(-1) < BRIGHTEST)[..., None].astype(float)
        least = _means(usable, factor)[..., 0] > 1.0 - 1e-9
        return ColourLevel(
            small, factor, _means(seen, factor), _means(room, factor), least.astype(float)
        )


def _means(image: Float[np.ndarray, "H W C"], factor: int) -> Float[np.ndarray, "h w C"]:
    height, width = (size // factor for size in image.shape[:2])
    return image.reshape(height, factor, width, factor, -1).mean((1, 3))
