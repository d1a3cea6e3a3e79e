"""What depth cameras saw of one person: views of depth, colour, an empty room, masks and keypoints
(T 4.6.1).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from habitus.errors import HabitusError
from habitus.observe.camera import Camera
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

FARTHEST = 12.0
"""Metres beyond which no depth camera for people measures."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """One shot of a person.

    depth (H, W): metres along the camera's axis, 0 where nothing was measured. ``camera`` takes
    points of the sensor's frame (x right, y down, z forward, metres; that of the depth camera) to
    depth pixels, ``colour_camera`` the same points to colour pixels: its rotation and translation
    are the way from the depth to the colour camera. background: depth of the same room without the
    person, as is ``background_colour``. mask: where the person is, in depth pixels. keypoints:
    pixels (u, v) in the colour image and confidence by name, as `habitus.body.keypoints` calls
    them.
    """

    depth: Float[np.ndarray, "H W"]
    camera: Camera
    colour: UInt8[np.ndarray, "h w 3"] | None = None
    colour_camera: Camera | None = None
    background: Float[np.ndarray, "H W"] | None = None
    background_colour: UInt8[np.ndarray, "h w 3"] | None = None
    mask: Bool[np.ndarray, "H W"] | None = None
    keypoints: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for name in ("depth", "background", "mask"):
            image = getattr(self, name)
            if image is not None and image.shape != size:
                raise HabitusError(
                    f"{self.name or 'a view'}: {name} has {_pixels(image.shape)}, the depth "
                    f"camera {_pixels(size)}; "
                    "give the intrinsics of this resolution"
                )
        if (self.colour is None) != (self.colour_camera is None):
            raise HabitusError(
                f"{self.name or 'a view'}: colour and its camera come together; give both or "
                "neither"
            )
        if self.colour_camera is not None:
            size = (self.colour_camera.height, self.colour_camera.width)
            for name in ("colour", "background_colour"):
                image = getattr(self, name)
                if image is not None and image.shape != (*size, 3):
                    raise HabitusError(
                        f"{self.name or 'a view'}: {name} has {_pixels(image.shape)}, the colour "
                        "camera "
                        f"{_pixels(size)}; give the intrinsics of this resolution"
                    )
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(self.depth) & (self.depth > 0) & (self.depth < FARTHEST)
        object.__setattr__(self, "depth", np.where(usable, self.depth, 0.0).astype(np.float32))

    @property
    def rays(self) -> Float[np.ndarray, "H W 3"]:
        """The direction of every depth pixel in the sensor's frame, z = 1; NaN where the lens shows
        none.
        """
        rows, columns = np.mgrid[: self.camera.height, : self.camera.width]
        pixels = np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2)
        rays = self.camera.rays(torch.from_numpy(pixels).to(self.camera.focal_length.dtype))
        return rays.numpy().reshape(self.camera.height, self.camera.width, 3)

    def points(self) -> Float[np.ndarray, "H W 3"]:
        """The points (m) that depth shows, in the sensor's frame; zero where nothing was
        measured.
        """
        return np.nan_to_num(self.rays) * self.depth[..., None]

    def in_camera_frame(self) -> "DepthView":
        """The same view with its depth camera at the origin: what it saw is in the sensor's frame.

        A calibrated camera, with a rotation and translation from a world, takes its colour camera
        along.
        """
        if not (self.camera.rotation.any() or self.camera.translation.any()):
            return self
        camera, colour = self.camera.to(torch.float64), self.colour_camera
        still = torch.zeros(3, dtype=torch.float64)
        if colour is not None:
            colour = colour.to(torch.float64)
            turn = matrix_from_rotvec(colour.rotation) @ matrix_from_rotvec(camera.rotation).mT
            colour = colour.replace(
                rotation=rotvec_from_matrix(turn),
                translation=colour.translation - turn @ camera.translation,
            )
        return replace(
            self, camera=camera.replace(rotation=still, translation=still), colour_camera=colour
        )

    def without(self, *names: str) -> "DepthView":
        """The same view without what these fields hold: "background" (both), "colour", "mask",
        "keypoints".
        """
        empty: dict[str, object] = {
            "background": {"background": None, "background_colour": None},
            "colour": {"colour": None, "colour_camera": None, "background_colour": None},
            "mask": {"mask": None},
            "keypoints": {"keypoints": {}},
        }
        fields: dict[str, object] = {}
        for name in names:
            fields |= empty[name]  # type: ignore[operator]
        return replace(self, **fields)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class RgbdCapture:
    """Views of one person, each turned otherwise, and what must be known of how they were read
    (``notes``).
    """

    name: str
    views: tuple[DepthView, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.views:
            raise HabitusError(f"{self.name}: no view; expected one depth image at least")

    def without(self, *names: str) -> "RgbdCapture":
        """The same without some fields of all views (`DepthView.without`)."""
        return replace(self, views=tuple(view.without(*names) for view in self.views))


def _pixels(shape: tuple[int, ...]) -> str:
    return " x ".join(str(size) for size in shape[1::-1]) + " pixels"
