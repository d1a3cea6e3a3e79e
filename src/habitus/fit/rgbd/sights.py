"""A view made ready for the fit: the person's points in a world that stands upright, and grids of
fewer pixels.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from habitus.fit.rgbd.floor import level_frame
from habitus.fit.rgbd.segment import Segment, seen_through
from habitus.observe.camera import Camera
from habitus.observe.depth_views import DepthView
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

MARGIN = 60
"""Pixels around the person that are looked at too: where the model may wrongly be."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Every stride-th pixel of the neighbourhood of a person, R x C.

    points: world (m). own: which show the person. behind: depth of what was seen through, 0
    elsewhere. nearest: the nearest pixel (row, column) that is the person's.
    """

    camera: Camera
    stride: int
    points: Float[np.ndarray, "R C 3"]
    own: Bool[np.ndarray, "R C"]
    behind: Float[np.ndarray, "R C"]
    eye: Float[np.ndarray, " 3"]

    @cached_property
    def nearest(self) -> Int[np.ndarray, "2 R C"]:
        """The nearest pixel that shows the person."""
        return distance_transform_edt(~self.own, return_distances=False, return_indices=True)


@dataclass(frozen=True, eq=False)
class Sight:
    """A view in its world (y up; the floor, where one was found, at 0): cameras, points (H, W, 3),
    and who is where.

    The world is ``turn`` times the sensor's frame, and ``shift``. way: how the person was parted
    from the room.
    """

    view: DepthView
    camera: Camera
    colour_camera: Camera | None
    points: Float[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]
    behind: Float[np.ndarray, "H W"]
    on_floor: bool
    noise: float | None
    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, " 3"]
    way: str

    @staticmethod
    def of(view: DepthView, found: Segment) -> "Sight":
        """The view in the world of its floor, or one whose y is the camera's own up."""
        if found.floor is not None:
            turn, shift = found.floor.world
        else:
            turn = level_frame(np.array([0.0, -1.0, 0.0]))
            shift = np.zeros(3)
        colour = None if view.colour_camera is None else in_world(view.colour_camera, turn, shift)
        points = view.points() @ turn.T + shift
        behind = seen_through(view, found.mask)
        on_floor = found.floor is not None
        camera = in_world(view.camera, turn, shift)
        return Sight(
            view,
            camera,
            colour,
            points,
            found.mask,
            behind,
            on_floor,
            found.noise,
            turn,
            shift,
            found.way,
        )

    @property
    def eye(self) -> Float[np.ndarray, " 3"]:
        """Where the camera is."""
        return self.shift

    @cached_property
    def cut_off(self) -> bool:
        """Whether the person reaches beyond the top or bottom of the image."""
        rows = np.flatnonzero(self.mask.any(1))
        return bool(rows[0] < 3 or rows[-1] > len(self.mask) - 4)

    def grid(self, stride: int) -> Grid:
        """Every stride-th pixel around the person."""
        part, camera = around(self.mask, self.camera, stride)
        return Grid(camera, stride, self.points[part], self.mask[part], self.behind[part], self.eye)


def around(
    mask: Bool[np.ndarray, "H W"], camera: Camera, stride: int
) -> tuple[tuple[slice, slice], Camera]:
    """Every stride-th pixel of the neighbourhood of a mask: the part of an image, and the camera
    that sees it.
    """
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    top = max(rows[0] - MARGIN, 0)
    left = max(columns[0] - MARGIN, 0)
    part = (slice(top, rows[-1] + MARGIN, stride), slice(left, columns[-1] + MARGIN, stride))
    first = torch.tensor([left + 0.5, top + 0.5], dtype=torch.float64)
    height, width = mask[part].shape
    small = camera.replace(
        width=width,
        height=height,
        focal_length=camera.focal_length / stride,
        principal_point=(camera.principal_point - first) / stride + 0.5,
    )
    return part, small


def in_world(
    camera: Camera, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, " 3"]
) -> Camera:
    """A camera of the sensor's frame as one of the world, which is ``turn`` times the frame, and
    ``shift``.
    """
    own = matrix_from_rotvec(camera.rotation).numpy() @ turn.T
    rotation = torch.from_numpy(np.array(rotvec_from_matrix(own)))
    return camera.replace(
        rotation=rotation, translation=camera.translation - torch.from_numpy(own @ shift)
    )
