"""A depth view prepared for the fit: the pixels that show the person (nearer than the empty room,
or standing out of floor and walls), their points in an upright world, and grids of fewer pixels.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_opening, convolve, distance_transform_edt, find_objects, label

from habitus.errors import HabitusError
from habitus.fit.points.floor import Floor, find_floor, level_frame
from habitus.observe.camera import Camera
from habitus.observe.depth_views import DepthView
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

LEAST_PIXELS = 400
JUMP = 0.05
"""Metres between neighbouring pixels that part two surfaces."""
ABOVE_FLOOR = 0.03
GROWTHS = 10
"""Times that the person is grown by 3 pixels of like depth, where walls and floor were told by
planes.
"""
REACH = 1.4
"""Metres from the middle of a person to the end of a limb."""


SEGMENTATIONS = ("planes", "mask", "background")
"""By what a person is told from the room, the least certain first."""
FOUND_BY = {
    "planes": "their distance from floor and walls",
    "mask": "the mask",
    "background": "the background image",
}
CHECK = {
    "planes": "somebody is in view, or give a background image or a mask",
    "mask": "the mask is of this view and depth was measured inside it",
    "background": "the camera did not move after the background was taken and somebody is in view",
}


@dataclass(frozen=True, eq=False)
class Segment:
    """Where the person is (H, W), the floor if it was found, and sd of depth over its square if the
    views tell; segmentation: by what the person was found, one of `SEGMENTATIONS`.
    """

    mask: Bool[np.ndarray, "H W"]
    floor: Floor | None
    noise: float | None
    segmentation: str


def segment(view: DepthView) -> Segment:
    """The person in a view: by the mask that is given, by the empty room, or by what stands out of
    planes.

    Raises HabitusError where nobody is found.
    """
    points = view.points()
    noise = None
    if view.background is not None:
        empty = DepthView(view.background, view.camera)
        floor = find_floor(empty.points(), empty.depth > 0)
        noise = _noise(view.depth, empty.depth)
        found = _nearer(view.depth, empty.depth, noise)
        segmentation = "background"
    else:
        floor = find_floor(points, view.depth > 0)
        found = _standing_out(view.depth, points, floor)
        segmentation = "planes"
    if view.mask is not None:
        found = view.mask & (view.depth > 0)
        segmentation = "mask"
    mask = _one_person(_without_flying(found, view.depth), points)
    if mask.sum() < LEAST_PIXELS:
        raise HabitusError(
            f"{view.name or 'the view'}: {int(mask.sum())} pixels of a person were found by "
            f"{FOUND_BY[segmentation]}; expected {LEAST_PIXELS} or more: check that "
            f"{CHECK[segmentation]}"
        )
    return Segment(mask, floor, noise, segmentation)


def _noise(depth: np.ndarray, empty: np.ndarray) -> float | None:
    """Spread of one image's depth over its square, of pixels that show the empty room twice."""
    both = (depth > 0) & (empty > 0)
    if both.sum() < LEAST_PIXELS:
        return None
    change = (depth - empty)[both] / empty[both] ** 2
    apart = np.abs(change - np.median(change))
    usual = apart[
        apart <= 6.0 * np.quantile(apart, 0.6)
    ]  # quantised depth has many equal ones: no median deviation
    return float(np.clip(max(np.sqrt(np.mean(usual**2) / 2.0), _rounding(depth)), 1e-4, 5e-3))


def _rounding(depth: np.ndarray) -> float:
    """What coarse steps of depth leave, as a spread over its square: images of a still room do not
    differ by it.
    """
    steps = np.unique(depth[depth > 0])
    return (
        float(np.median(np.diff(steps) / steps[1:] ** 2) / np.sqrt(12.0)) if len(steps) > 1 else 0.0
    )


def _nearer(depth: np.ndarray, empty: np.ndarray, noise: float | None) -> np.ndarray:
    tolerance = np.maximum(0.02, 6.0 * (noise or 1.5e-3) * empty**2)
    return (depth > 0) & (empty > 0) & (depth < empty - tolerance)


def _standing_out(depth: np.ndarray, points: np.ndarray, floor: Floor | None) -> np.ndarray:
    """What is above the floor, in one piece, nearest to the middle of the image: walls behind are
    another piece.
    """
    found = depth > 0
    if floor is not None:
        above = floor.above(points)
        found &= (above > ABOVE_FLOOR) & (above < 2.4)
    smooth = found.copy()
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis, prepend=depth.take([0], axis)))
        smooth &= step < JUMP
    pieces, count = cast(tuple[np.ndarray, int], label(binary_opening(smooth)))
    best = found & False
    most = 0.0
    for k, where in enumerate(find_objects(pieces), 1):
        piece = pieces[where] == k
        near = depth[where][piece]
        size = piece.sum()
        if size < LEAST_PIXELS or k > count:
            continue
        off = abs((where[1].start + where[1].stop) / 2 / depth.shape[1] - 0.5)
        tall = np.ptp(points[where][piece][:, 1])
        score = min(tall, 2.0) * (1.0 - off) / np.median(near) * (tall > 0.5)
        if score > most and np.ptp(np.percentile(points[where][piece][:, 0], (1, 99))) < 2.2:
            best = np.zeros_like(found)
            most = score
            best[where] = piece
    for _ in range(GROWTHS if best.any() else 0):  # arms are thin, and opening cut them off
        best = found & _grown(best, depth)
    return best


def _grown(piece: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The piece and what lies within 3 pixels of it and at its depth."""
    away, nearest = cast(
        tuple[np.ndarray, np.ndarray], distance_transform_edt(~piece, return_indices=True)
    )
    return (away <= 3) & (np.abs(depth - depth[tuple(nearest)]) < JUMP)


def _without_flying(mask: Bool[np.ndarray, "H W"], depth: Float[np.ndarray, "H W"]) -> np.ndarray:
    """Without pixels that fewer than four neighbours agree with: mixed depths at borders, and
    single ones.
    """
    agree = np.zeros(mask.shape, np.int8)
    tolerance = 0.02 + 0.004 * depth**2
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            if down or across:
                there = np.roll(np.where(mask, depth, -9.0), (down, across), (0, 1))
                agree += np.abs(there - depth) < tolerance
    return mask & (agree >= 4)


def _one_person(mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The largest piece and others within a limb's reach of it, without specks."""
    pieces, count = cast(tuple[np.ndarray, int], label(mask, structure=np.ones((3, 3))))
    if not count:
        return mask
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)[1:]
    main = int(sizes.argmax()) + 1
    middle = np.median(points[pieces == main], axis=0)
    kept = np.zeros(count + 1, bool)
    for k in np.flatnonzero(sizes >= max(0.003 * sizes.max(), 12)) + 1:
        where = np.median(points[pieces == k], axis=0)
        kept[k] = k == main or (
            np.linalg.norm((where - middle)[[0, 2]]) < REACH and abs(where[2] - middle[2]) < 0.8
        )
    return kept[pieces]


def seen_through(view: DepthView, mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Depth (m) that was measured of what is not the person, 0 elsewhere, on pixels well off the
    person's border.
    """
    crowded = convolve((~mask).astype(np.int8), np.ones((3, 3), np.int8), mode="nearest") == 9
    return np.where(crowded & (view.depth > 0), view.depth, 0.0)


MIN_GRID_PIXELS = 24
"""Pixels of the person in a grid: with fewer its middle and its nearest points are undefined."""
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
        return np.asarray(
            distance_transform_edt(~self.own, return_distances=False, return_indices=True)
        )


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A view in its world (y up; the floor, where one was found, at 0): cameras, points (H, W, 3),
    and who is where.

    The world is ``turn`` times the sensor's frame, and ``shift``. segmentation: one of
    `SEGMENTATIONS`.
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
    segmentation: str

    @staticmethod
    def of(view: DepthView, found: Segment) -> "PreparedView":
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
        return PreparedView(
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
            found.segmentation,
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
        """Every stride-th pixel around the person; a smaller stride where that would leave fewer
        than `MIN_GRID_PIXELS` of them.
        """
        part, camera = around(self.mask, self.camera, stride)
        while stride > 1 and self.mask[part].sum() < MIN_GRID_PIXELS:
            stride -= 1
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
