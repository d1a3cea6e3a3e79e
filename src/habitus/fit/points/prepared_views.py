"""A depth view prepared for the fit: the pixels that show the person (nearer than the empty room,
or standing out of floor and walls), their points in an upright world, and grids of fewer pixels.
The floor is the largest level plane below the camera: its normal is up, and E_F (thesis eq. 4.6)
keeps the soles on it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_opening, convolve, distance_transform_edt, label

from habitus.errors import HabitusError
from habitus.fit.points.depth_settings import NOISE, SEGMENTATION, SegmentationSettings
from habitus.observe.camera import Camera, DepthView
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

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
class Floor:
    """A plane in the sensor's frame: ``normal`` (up) times a point is ``height``; below the camera
    height < 0.
    """

    normal: Float[np.ndarray, " 3"]
    height: float

    def above(self, points: Float[np.ndarray, "*any 3"]) -> Float[np.ndarray, "*any"]:
        """Metres of points above it."""
        return points @ self.normal - self.height

    @property
    def world(self) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
        """Rotation and translation from the sensor's frame to a world with y up and the floor at
        0.
        """
        return level_frame(self.normal), np.array([0.0, -self.height, 0.0])


def level_frame(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation from the sensor's frame to one whose y is up and whose z points back to the
    camera.
    """
    back = np.array([0.0, 0.0, -1.0])
    back = back - up * (back @ up)
    back /= np.linalg.norm(back)
    return np.stack([np.cross(up, back), up, back])


def find_floor(
    points: Float[np.ndarray, "H W 3"],
    seen: Bool[np.ndarray, "H W"],
    settings: SegmentationSettings = SEGMENTATION,
    seed: int = 0,
) -> Floor | None:
    """The floor among the points (m) that were seen, or None. Sensor's frame: y down, z forward."""
    on_floor = points[seen]
    if len(on_floor) < settings.min_floor_points:
        return None
    rng = np.random.default_rng(seed)
    some = on_floor[
        rng.choice(len(on_floor), min(settings.floor_points, len(on_floor)), replace=False)
    ]
    best = None
    best_score = 0.0
    for _ in range(settings.floor_tries):
        plane = _through(some[rng.choice(len(some), 3, replace=False)], settings)
        if plane is None:
            continue
        share = np.mean(np.abs(plane.above(some)) < _tolerance(some, settings))
        below = np.mean(plane.above(some) < -2.0 * _tolerance(some, settings))
        allowed = (
            plane.height < -settings.min_camera_height
            and share > settings.min_floor_share
            and below < settings.max_below
        )
        if allowed and share - below > best_score:
            best = plane
            best_score = float(share - below)
    return None if best is None else _refined(best, on_floor, settings)


def _tolerance(points: np.ndarray, settings: SegmentationSettings) -> np.ndarray:
    """Distance (m) from a plane within which points count as on it."""
    return settings.floor_distance + settings.floor_noise * points[:, 2] ** 2


def _through(points: Float[np.ndarray, "3 3"], settings: SegmentationSettings) -> Floor | None:
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    length = np.linalg.norm(normal)
    if length < 1e-6:
        return None
    normal = normal / length * -np.sign(normal[1] or 1.0)
    if -normal[1] < np.cos(np.deg2rad(settings.max_tilt)):
        return None
    return Floor(normal, float(points[0] @ normal))


def _refined(plane: Floor, points: np.ndarray, settings: SegmentationSettings) -> Floor:
    """The plane of least squares through the points near it, each by its certainty."""
    for _ in range(3):
        near = points[np.abs(plane.above(points)) < _tolerance(points, settings)]
        weight = 1.0 / near[:, 2] ** 4
        middle = (near * weight[:, None]).sum(0) / weight.sum()
        offsets = near - middle
        normal = np.linalg.eigh((offsets * weight[:, None]).T @ offsets)[1][:, 0]
        normal = normal * -np.sign(normal[1] or 1.0)
        plane = Floor(normal, float(middle @ normal))
    return plane


@dataclass(frozen=True, eq=False)
class Segment:
    """Where the person is (H, W), the floor if it was found, and sd of depth over its square if the
    views tell; segmentation: by what the person was found, one of `SEGMENTATIONS`.
    """

    mask: Bool[np.ndarray, "H W"]
    floor: Floor | None
    noise: float | None
    segmentation: str


def segment(view: DepthView, settings: SegmentationSettings = SEGMENTATION) -> Segment:
    """The person in a view: by the mask that is given, by the empty room, or by what stands out of
    planes.

    Raises HabitusError where nobody is found.
    """
    points = view.points()
    noise = None
    if view.background is not None:
        empty = DepthView(view.background, view.camera)
        floor = find_floor(empty.points(), empty.depth > 0, settings)
        noise = _noise(view.depth, empty.depth, settings)
        person = _nearer(view.depth, empty.depth, noise, settings)
        segmentation = "background"
    else:
        floor = find_floor(points, view.depth > 0, settings)
        person = _standing_out(view.depth, points, floor, settings)
        segmentation = "planes"
    if view.mask is not None:
        person = view.mask & (view.depth > 0)
        segmentation = "mask"
    mask = _one_person(without_flying(person, view.depth), points, settings)
    if mask.sum() < settings.min_pixels:
        raise HabitusError(
            f"{view.name or 'the view'}: {int(mask.sum())} pixels of a person were segmented by "
            f"{FOUND_BY[segmentation]}; expected {settings.min_pixels} or more: check that "
            f"{CHECK[segmentation]}"
        )
    return Segment(mask, floor, noise, segmentation)


def _noise(depth: np.ndarray, empty: np.ndarray, settings: SegmentationSettings) -> float | None:
    """Spread of one image's depth over its square, of pixels that show the empty room twice."""
    both = (depth > 0) & (empty > 0)
    if both.sum() < settings.min_pixels:
        return None
    change = (depth - empty)[both] / empty[both] ** 2
    deviations = np.abs(change - np.median(change))
    usual = deviations[
        deviations <= 6.0 * np.quantile(deviations, 0.6)
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


def _nearer(
    depth: np.ndarray, empty: np.ndarray, noise: float | None, settings: SegmentationSettings
) -> np.ndarray:
    spread = (noise or NOISE) * empty**2
    tolerance = np.maximum(settings.min_noise_difference, settings.background_noises * spread)
    return (depth > 0) & (empty > 0) & (depth < empty - tolerance)


def _standing_out(
    depth: np.ndarray, points: np.ndarray, floor: Floor | None, settings: SegmentationSettings
) -> np.ndarray:
    """What is above the floor, in one piece, nearest to the middle of the image: walls behind are
    another piece.
    """
    above, pieces = standing_pieces(depth, points, floor, settings)
    best = above & False
    most = 0.0
    for piece in pieces:
        columns = np.flatnonzero(piece.any(0))
        off = abs((columns[0] + columns[-1] + 1) / 2 / depth.shape[1] - 0.5)
        tall = np.ptp(points[piece][:, 1])
        score = min(tall, 2.0) * (1.0 - off) / np.median(depth[piece])
        if score > most:
            most, best = score, piece
    return whole_piece(best, above, depth, settings)


def standing_pieces(
    depth: np.ndarray, points: np.ndarray, floor: Floor | None, settings: SegmentationSettings
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The pixels above the floor, and connected components of them that are separated in depth and
    no wider than a person.
    """
    above = depth > 0
    if floor is not None:
        height = floor.above(points)
        above &= (height > settings.above_floor) & (height < settings.max_height)
    smooth = above.copy()
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis, prepend=depth.take([0], axis)))
        smooth &= step < settings.jump
    labels, _ = cast(tuple[np.ndarray, int], label(binary_opening(smooth)))
    pieces = []
    for k in np.flatnonzero(np.bincount(labels.ravel()) >= settings.min_pixels):
        piece = labels == k
        wide = np.ptp(np.percentile(points[piece][:, 0], (1, 99)))
        if k and np.ptp(points[piece][:, 1]) > 0.5 and wide < settings.max_width:
            pieces.append(piece)
    return above, pieces


def whole_piece(
    piece: np.ndarray, above: np.ndarray, depth: np.ndarray, settings: SegmentationSettings
) -> np.ndarray:
    """A piece with what hangs on it: arms are thin."""
    for _ in range(settings.growths if piece.any() else 0):
        piece = above & _grown(piece, depth, settings)
    return piece


def _grown(piece: np.ndarray, depth: np.ndarray, settings: SegmentationSettings) -> np.ndarray:
    """The piece and what lies within a few pixels of it and at its depth."""
    distance, nearest = cast(
        tuple[np.ndarray, np.ndarray], distance_transform_edt(~piece, return_indices=True)
    )
    similar = np.abs(depth - depth[tuple(nearest)]) < settings.jump
    return (distance <= settings.growth_pixels) & similar


def without_flying(mask: Bool[np.ndarray, "H W"], depth: Float[np.ndarray, "H W"]) -> np.ndarray:
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


def _one_person(mask: np.ndarray, points: np.ndarray, settings: SegmentationSettings) -> np.ndarray:
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
        across = np.linalg.norm((where - middle)[[0, 2]])
        near = across < settings.limb_reach and abs(where[2] - middle[2]) < settings.limb_depth
        kept[k] = k == main or near
    return kept[pieces]


def seen_through(
    view: DepthView, person: Segment, settings: SegmentationSettings = SEGMENTATION
) -> Float[np.ndarray, "H W"]:
    """Depth (m) that was measured of what is not the person, 0 elsewhere, on pixels well off the
    person's border.

    Mixed depths of a hand and the wall behind it are neither the person's nor the room's: pixels
    with them are left out, and so are pixels nearer than the empty room.
    """
    outside = ~person.mask
    crowded = convolve(outside.astype(np.int8), np.ones((3, 3), np.int8), mode="nearest") == 9
    room = crowded & without_flying(view.depth > 0, view.depth)
    if view.background is not None:
        room &= ~_nearer(view.depth, view.background, person.noise, settings)
    return np.where(room, view.depth, 0.0)


@dataclass(frozen=True, eq=False)
class Grid:
    """Every stride-th pixel of the neighbourhood of a person, R x C.

    points: world (m). person: which show the person. behind: depth of what was seen through, 0
    elsewhere. nearest: the nearest pixel (row, column) that is the person's.
    """

    camera: Camera
    stride: int
    points: Float[np.ndarray, "R C 3"]
    person: Bool[np.ndarray, "R C"]
    behind: Float[np.ndarray, "R C"]
    eye: Float[np.ndarray, " 3"]

    @cached_property
    def nearest(self) -> Int[np.ndarray, "2 R C"]:
        """The nearest pixel that shows the person."""
        return np.asarray(
            distance_transform_edt(~self.person, return_distances=False, return_indices=True)
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
    settings: SegmentationSettings = SEGMENTATION

    @staticmethod
    def of(
        view: DepthView, segment: Segment, settings: SegmentationSettings = SEGMENTATION
    ) -> "PreparedView":
        """The view in the world of its floor, or one whose y is the camera's own up."""
        if segment.floor is not None:
            turn, shift = segment.floor.world
        else:
            turn = level_frame(np.array([0.0, -1.0, 0.0]))
            shift = np.zeros(3)
        colour = None if view.colour_camera is None else in_world(view.colour_camera, turn, shift)
        points = view.points() @ turn.T + shift
        behind = seen_through(view, segment, settings)
        on_floor = segment.floor is not None
        camera = in_world(view.camera, turn, shift)
        return PreparedView(
            view,
            camera,
            colour,
            points,
            segment.mask,
            behind,
            on_floor,
            segment.noise,
            turn,
            shift,
            segment.segmentation,
            settings,
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
        than `SegmentationSettings.grid_pixels` of them.
        """
        margin = self.settings.margin
        part, camera = around(self.mask, self.camera, stride, margin)
        while stride > 1 and self.mask[part].sum() < self.settings.grid_pixels:
            stride -= 1
            part, camera = around(self.mask, self.camera, stride, margin)
        return Grid(camera, stride, self.points[part], self.mask[part], self.behind[part], self.eye)


def around(
    mask: Bool[np.ndarray, "H W"], camera: Camera, stride: int, margin: int
) -> tuple[tuple[slice, slice], Camera]:
    """Every stride-th pixel of the neighbourhood of a mask: the part of an image, and the camera
    that sees it.
    """
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    top = max(rows[0] - margin, 0)
    left = max(columns[0] - margin, 0)
    part = (slice(top, rows[-1] + margin, stride), slice(left, columns[-1] + margin, stride))
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
