"""From detections of calibrated cameras to a body in motion.

1. People are matched between cameras and followed (`people`), their keypoints triangulated.
2. Each person's place and heading in every frame from hips and shoulders; poses by the triangulated
   points, frame by frame. Of one camera place and heading are found by its pixels (`one_camera`).
3. In rounds: the shape stage on frames unlike each other (`shape`: betas, the detector's own places
   of keypoints, corrections of cameras), then the pose stage on all (`sequence`), by pixels. After
   each round left and right that a camera exchanged are put back, the noise of each keypoint in
   each camera and each camera's time offset are found.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.cameras.one_camera import STILL_SD, placed_by_one, standing_points
from habitus.fit.cameras.people import Track, chosen, tracks
from habitus.fit.cameras.result import CameraFit
from habitus.fit.cameras.review import (
    MIN_HEIGHT_PX,
    Sight,
    information,
    of_frames,
    reviewed,
    shifted,
)
from habitus.fit.cameras.sequence import keypoint_data, solve_poses
from habitus.fit.cameras.settings import CAMERAS, NOTHING, CameraSettings, Known
from habitus.fit.cameras.shape import CameraShape, ShapeData, betas_of_height, shape_stage
from habitus.fit.cameras.triangulate import triangulated
from habitus.mesh.proximity import farthest_points
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections
from habitus.observe.keypoints import KeypointRig, ShapedKeypoints
from habitus.rotations import procrustes, rotvec_from_matrix, up_rotation

Progress = Callable[[str, float], None]
MIN_KEYPOINTS = 6
"""Of a frame of one camera."""
MAX_FLOOR_ERROR = 0.15
"""Metres of feet that stand from their places on the floor."""
OnFloor = tuple[Float[np.ndarray, "T K 3"], Float[np.ndarray, "T K"]] | tuple[None, None]
TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")


def fit_cameras(
    body: BodyModel,
    prior: PosePrior,
    detections: Detections,
    rig: CameraRig,
    settings: CameraSettings = CAMERAS,
    *,
    people: int | None = None,
    known: Known = NOTHING,
    correct: bool = True,
    progress: Progress = lambda stage, share: None,
) -> list[CameraFit]:
    """Everybody whom the cameras see, or the first ``people``.

    known: the one person's height, the floor, the world's upward axis, as far as they are known.
    correct: estimate corrections of the cameras. One camera does not determine depth: the verdict
    is doubtful at best. Raises HabitusError where nobody is seen by two cameras, or by the one
    there is.
    """
    progress("people", 0.0)
    found = chosen(tracks(detections.of_cameras(rig.names), rig, settings), people)
    fits = []
    for k, track in enumerate(found):
        progress("person", (k + 0.1) / len(found))
        fits.append(
            fit_person(body, prior, detections, track, rig, settings, known, correct, k, len(found))
        )
    return fits


@dataclass(frozen=True, eq=False)
class Start:
    """One person before the rounds: detections, triangulated keypoints (T, K, 3; m), poses and
    places of the frames from ``first_frame`` on.
    """

    sight: Sight
    points: Float[np.ndarray, "T K 3"]
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    first_frame: int


def fit_person(
    body: BodyModel,
    prior: PosePrior,
    detections: Detections,
    track: Track,
    rig: CameraRig,
    settings: CameraSettings,
    known: Known,
    correct: bool,
    number: int,
    total: int,
) -> CameraFit:
    """One person's shape and motion: person ``number`` of ``total``; other arguments as of
    `fit_cameras`.
    """
    began = time.perf_counter()
    keypoints = KeypointRig.of(body, detections.names, detections.convention)
    alone = len(rig.cameras) == 1
    correct = correct and not alone
    begin = start_alone if alone else start_person
    start = begin(body, prior, detections, track, rig, keypoints, settings, known)
    up = upright(start.points, keypoints, known.up)
    sight, pose, trans = start.sight, start.pose, start.trans
    given = prior.for_joints(body.joint_names)
    none = np.zeros((len(keypoints.names), 3)), np.zeros((len(rig.cameras), 6))
    shape = CameraShape(np.zeros(body.num_betas), none[0], rig, none[1], pose, trans, "", {})
    status = ""
    free, was_free, rate = False, False, detections.rate_hz
    for k in range(settings.rounds):
        late = shifted(sight, detections.rate_hz)
        rows = unlike_frames(start.points, sight, settings.frames)
        wide = settings.noise * settings.camera_noise
        data = ShapeData(rig, late[rows], information(sight, keypoints, wide)[rows])
        here = replace(shape, pose=pose[rows], trans=trans[rows])
        reaches = settings.reaches if k == 0 else settings.reaches[1:]
        shape = shape_stage(
            body, prior, keypoints, data, here, settings, reaches, known.height, free
        )
        person = keypoints.shaped(shape.betas, shape.offsets)
        floor = on_floor(late, sight, shape.rig, keypoints, person, known, up, rate)
        every = keypoint_data(
            person,
            shape.rig,
            late,
            information(sight, keypoints, settings.noise),
            given.mean,
            settings.pose * given.precision,
            settings.reach,
            *floor,
        )
        warm = 0 < k < settings.rounds - 1 and free == was_free  # slow waves want coarse levels
        pose, trans, solution = solve_poses(every, pose, trans, rate, settings, warm)
        status, was_free = solution.status, free
        if k + 1 < settings.rounds:
            expected = shape.rig.project(person.points(pose, trans)).transpose(1, 0, 2, 3)
            sight, biased = reviewed(sight, expected, keypoints, rate, settings, free, correct)
            free = free or biased
    fit = CameraFit.solved(
        body=body,
        shape=shape,
        keypoints=keypoints,
        pose=pose,
        trans=trans,
        rate_hz=detections.rate_hz,
        first_frame=start.first_frame,
        sight=sight,
        pixels=shifted(sight, detections.rate_hz),
        points=start.points,
        given_rig=rig,
        detections=detections,
        up_axis=up,
        height=known.height,
        status=status,
        number=number,
        total=total,
        seconds=time.perf_counter() - began,
    )
    if floor[0] is None:
        return fit
    return replace(fit, warnings=(*fit.warnings, *floor_notes(fit.keypoints, floor[0])))


def start_person(
    body: BodyModel,
    prior: PosePrior,
    detections: Detections,
    track: Track,
    rig: CameraRig,
    keypoints: KeypointRig,
    settings: CameraSettings,
    known: Known = NOTHING,
) -> Start:
    """Poses of the mean shape by triangulated keypoints, over the frames in which shoulders and
    hips are known. Raises HabitusError where they are known in too few.
    """
    sight, points = first_sight(track, rig, settings)
    found = np.flatnonzero(trunk_seen(points, keypoints.names))
    if len(found) < min(5, len(points)):
        raise HabitusError(
            f"{detections.name}: shoulders and hips meet in space in {len(found)} of {len(points)} "
            "frames; check that cameras and detections have the same names and frames"
        )
    kept = slice(int(found[0]), int(found[-1]) + 1)
    sight, points = of_frames(sight, kept), points[kept]
    given = prior.for_joints(body.joint_names)
    person = keypoints.shaped(np.zeros(body.num_betas), np.zeros((len(keypoints.names), 3)))
    pose, trans = placed(points, keypoints, person, given.mean)
    triangulation = settings.triangulation
    weights = np.full(points.shape[:2], 1.0 / triangulation.max_point_error**2)
    rough = keypoint_data(
        person,
        None,
        None,
        None,
        given.mean,
        given.precision,
        triangulation.reach,
        points,
        weights,
    )
    pose, trans, _ = solve_poses(rough, pose, trans, detections.rate_hz, settings)
    return Start(sight, points, pose, trans, kept.start)


def start_alone(
    body: BodyModel,
    prior: PosePrior,
    detections: Detections,
    track: Track,
    rig: CameraRig,
    keypoints: KeypointRig,
    settings: CameraSettings,
    known: Known = NOTHING,
) -> Start:
    """Of one camera: the mean pose put by its pixels, then poses by them with a falling reach.
    Raises HabitusError where too few frames show the person.
    """
    enough = np.flatnonzero((track.confidence[:, 0] > 0.0).sum(1) >= MIN_KEYPOINTS)
    if len(enough) < min(5, len(track.pixels)):
        raise HabitusError(
            f"{detections.name}: {len(enough)} of {len(track.pixels)} frames show "
            f"{MIN_KEYPOINTS} keypoints or more of a person"
        )
    kept = slice(int(enough[0]), int(enough[-1]) + 1)
    pixels, sure = track.pixels[kept], track.confidence[kept]
    given = prior.for_joints(body.joint_names)
    height = known.height
    betas = np.zeros(body.num_betas) if height is None else betas_of_height(body, height)
    person = keypoints.shaped(betas, np.zeros((len(keypoints.names), 3)))
    camera = rig.cameras[0]
    pose, trans = placed_by_one(
        camera, pixels[:, 0], sure[:, 0], keypoints.names, person, given.mean
    )
    middle = person.joints[0] + trans
    depth = np.maximum(middle @ camera.rotation[2] + camera.translation[2], 0.3)
    size = (height or 1.7) * camera.focal.mean() / depth
    sight = Sight(
        pixels,
        sure,
        size[:, None],
        np.ones((1, len(keypoints.names))),
        np.zeros(1),
        np.zeros((len(pixels), 1), bool),
    )
    up = upright(person.points(pose, trans), keypoints, known.up)
    floor = on_floor(pixels, sight, rig, keypoints, person, known, up, detections.rate_hz)
    for reach in settings.reaches:
        seen = keypoint_data(
            person,
            rig,
            pixels,
            information(sight, keypoints, settings.noise),
            given.mean,
            given.precision,
            reach,
            *floor,
        )
        pose, trans, _ = solve_poses(seen, pose, trans, detections.rate_hz, settings)
    points = np.where(sure[:, 0, :, None] > 0.0, person.points(pose, trans), np.nan)
    return Start(sight, points, pose, trans, kept.start)


def on_floor(
    pixels: Float[np.ndarray, "T C K 2"],
    sight: Sight,
    rig: CameraRig,
    keypoints: KeypointRig,
    person: ShapedKeypoints,
    known: Known,
    up: str,
    rate_hz: float,
) -> OnFloor:
    """Where feet of one camera stand on a known floor (m), NaN elsewhere, and the weights (1 /
    m^2); None of both with several cameras, or without a floor.
    """
    if known.floor is None or len(rig.names) > 1:
        return None, None
    points = standing_points(
        rig.cameras[0],
        pixels[:, 0],
        sight.size[:, 0],
        keypoints.names,
        person,
        up_rotation(up),
        known.floor,
        rate_hz,
    )
    return points, np.full(points.shape[:2], 1.0 / STILL_SD**2)


def floor_notes(
    points: Float[np.ndarray, "T K 3"], standing: Float[np.ndarray, "T K 3"]
) -> tuple[str, ...]:
    """What is said where feet never stand on the floor, or are elsewhere."""
    known = np.isfinite(standing[..., 0])
    if not known.any():
        return ("no foot stands still where the floor is; it was not used",)
    off = float(np.median(np.linalg.norm(points[known] - standing[known], axis=-1)))
    if off < MAX_FLOOR_ERROR:
        return ()
    return (
        f"feet that stand are {100 * off:.0f} cm from where the floor has them (median); check the "
        "floor, the axis up and the unit of the calibration",
    )


def first_sight(
    track: Track, rig: CameraRig, settings: CameraSettings
) -> tuple[Sight, Float[np.ndarray, "T K 3"]]:
    """Detections with the person's size in every camera, and the triangulated keypoints."""
    pixels = np.moveaxis(track.pixels, 1, 0)
    sure = np.moveaxis(track.confidence, 1, 0)
    with np.errstate(all="ignore"):
        span = np.nanmax(track.pixels, axis=2) - np.nanmin(
            np.where(np.isfinite(track.pixels), track.pixels, np.inf), axis=2
        )
    rough = np.linalg.norm(np.where(np.isfinite(span), span, 0.0), axis=-1)
    typical = np.array([np.median(own[own > 0]) if (own > 0).any() else 1.0 for own in rough.T])
    reach = settings.triangulation.max_error * np.maximum(typical, MIN_HEIGHT_PX)
    points = triangulated(rig, pixels, sure, reach[:, None, None])[0]
    middle = np.nanmedian(points, axis=1)
    known = np.isfinite(middle).all(1)
    if not known.any():
        raise HabitusError("no keypoint meets in space; check the calibration and the frames")
    middle = np.stack(
        [
            np.interp(np.arange(len(middle)), np.flatnonzero(known), middle[known, i])
            for i in range(3)
        ],
        1,
    )
    depth = np.einsum("ci,ti->tc", rig.rotation[:, 2], middle) + rig.translation[:, 2]
    size = 1.7 * rig.focal.mean(1) / np.maximum(depth, 0.3)
    shape = track.pixels.shape
    sight = Sight(
        track.pixels,
        track.confidence,
        size,
        np.ones(shape[1:3]),
        np.zeros(shape[1]),
        np.zeros(shape[:2], bool),
    )
    return sight, points


def trunk_rows(names: tuple[str, ...]) -> list[int]:
    """Shoulders and hips. Raises HabitusError for a convention without them."""
    if missing := [name for name in TRUNK if name not in names]:
        raise HabitusError(f"no keypoint {missing[0]!r}; expected shoulders and hips")
    return [names.index(name) for name in TRUNK]


def trunk_seen(
    points: Float[np.ndarray, "T K 3"], names: tuple[str, ...]
) -> Bool[np.ndarray, " T"]:
    """Frames in which three or more of shoulders and hips are known."""
    return np.isfinite(points[:, trunk_rows(names)]).all(2).sum(1) >= 3


def upright(points: Float[np.ndarray, "T K 3"], rig: KeypointRig, up: str) -> str:
    """The world's axis that points up: as given, or from hips to shoulders over all frames."""
    if up != "auto":
        return up
    rows = trunk_rows(rig.names)
    ends = []
    for pair in (rows[:2], rows[2:]):
        both = points[:, pair].reshape(-1, 3)
        both = both[np.isfinite(both).all(1)]
        if not len(both):
            raise HabitusError("shoulders or hips are nowhere known; name the axis up (--up)")
        ends.append(np.median(both, axis=0))
    along = ends[0] - ends[1]
    axis = int(np.abs(along).argmax())
    return ("+" if along[axis] > 0 else "-") + "xyz"[axis]


def placed(
    points: Float[np.ndarray, "T K 3"],
    rig: KeypointRig,
    person: ShapedKeypoints,
    mean: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """The mean pose in every frame, turned and put by shoulders and hips; frames without them as
    the nearest ones.
    """
    rows = trunk_rows(rig.names)
    frames = len(points)
    pose = np.concatenate([np.zeros(3), mean]).reshape(1, -1, 3)
    at_rest = person.points(pose, np.zeros((1, 3)))[0, rows]
    root = person.joints[0]
    known = np.flatnonzero(trunk_seen(points, rig.names))
    seen = points[known][:, rows]
    there = np.asarray(np.isfinite(seen).all(2))
    seen = np.where(there[..., None], seen, 0.0)
    turn, shift = procrustes(np.broadcast_to(at_rest, seen.shape), seen, there.astype(float))
    shift = shift + turn @ root - root
    nearest = np.searchsorted(0.5 * (known[1:] + known[:-1]), np.arange(frames))
    poses = np.repeat(pose, frames, axis=0)
    poses[:, 0] = rotvec_from_matrix(turn)[nearest]
    return poses, shift[nearest]


def unlike_frames(points: Float[np.ndarray, "T K 3"], sight: Sight, count: int) -> np.ndarray:
    """Frames for the shape stage: well seen, and unlike each other."""
    seen = (sight.confidence > 0.0).sum((1, 2))
    good = np.flatnonzero(seen >= np.quantile(seen, 0.5))
    middle = np.nanmedian(points[good], axis=1, keepdims=True)
    posture = np.nan_to_num(points[good] - middle).reshape(len(good), -1)
    first = int(np.linalg.norm(posture - posture.mean(0), axis=1).argmin())
    return np.sort(good[farthest_points(posture, min(count, len(good)), first)])
