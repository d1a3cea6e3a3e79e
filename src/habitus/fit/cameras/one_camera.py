"""The start of a fit to keypoints of one camera: where the person is and faces in every frame.

Of the mean pose at headings about the image's vertical and some tilts, the place is linear in the
pixels (u z = f x, weighted by confidence):

    (p_xy + t_xy) - (u - c) / f (p_z + t_z) = 0

The heading of each frame is the one that costs least over all frames, turns included (Viterbi).
Trunk and head decide; limbs, which the mean pose does not know, weigh little.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.observe.camera_rig import RigCamera
from habitus.observe.keypoints import ShapedKeypoints
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

HEADINGS = 24
TILTS = (-30.0, -10.0, 10.0, 30.0)
"""Degrees about the image's horizontal, of the camera's own tilt and of leaning people."""
LIMBS = 0.05
"""Weight of keypoints of arms and legs; those of the trunk and the head have 1."""
STEADY = ("shoulder", "hip", "neck", "nose", "eye", "ear", "head", "top")
"""Parts of the names of keypoints on trunk and head."""
MISFIT = 0.06
"""Distance of keypoints from those of the mean pose (sd), as a share of the person's height."""
FOOT = ("heel", "toe", "hallux")
"""Parts of the names of keypoints on the sole."""
SOLE = 0.02
"""Metres of the lowest keypoint of a foot above the floor."""
STILL_SECONDS, STILL_SPEED = 0.12, 0.25
"""A point of the sole that moves more slowly (m/s, across the view) over this time stands,"""
STILL_SD = 0.04
"""at its place on the floor to this (m, sd)."""
PERSON_HEIGHT = 1.7
"""Metres, of the size in pixels."""
TURN = 4.0
"""Cost of a radian's turn between frames."""


def placed_by_one(
    camera: RigCamera,
    pixels: Float[np.ndarray, "T K 2"],
    confidence: Float[np.ndarray, "T K"],
    names: tuple[str, ...],
    person: ShapedKeypoints,
    mean: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Pose (rad) and place (m, in the world) of a person in every frame: the mean pose, turned and
    placed by pixels without distortion (NaN where missing). mean: of all joints but the root.

    A frame that shows fewer than four keypoints is as the nearest one that shows more.
    """
    pose = np.concatenate([np.zeros(3), mean]).reshape(1, -1, 3)
    own = person.points(pose, np.zeros((1, 3)))[0] - person.joints[0]
    height = float(np.ptp(person.joints[:, 1])) * 1.1
    trunk = np.array([any(part in name for part in STEADY) for name in names])
    weight = np.where(np.isfinite(pixels).all(-1), confidence, 0.0) * np.where(trunk, 1.0, LIMBS)
    weight = np.where(((weight > 0.0).sum(1) >= 4)[:, None], weight, 0.0)
    turns = _turns()
    costs = np.empty((len(pixels), len(turns)))
    places = np.empty((len(pixels), len(turns), 3))
    plane = np.where(weight[..., None] > 0.0, (pixels - camera.centre) / camera.focal, 0.0)
    for k, turn in enumerate(turns):
        places[:, k], costs[:, k] = _place(own @ turn.T, plane, weight, height)
    known = np.flatnonzero(weight.any(1))
    path = _cheapest(costs[known], _angles(turns))
    nearest = np.searchsorted(0.5 * (known[1:] + known[:-1]), np.arange(len(pixels)))
    chosen = path[nearest]
    there = places[known[nearest], chosen]
    root = (there - camera.translation) @ camera.rotation
    poses = np.repeat(pose, len(pixels), axis=0)
    poses[:, 0] = rotvec_from_matrix(camera.rotation.T @ turns[chosen])
    return poses, root - person.joints[0]


def _turns() -> Float[np.ndarray, "H 3 3"]:
    """From a body that stands (y up) to the camera's frame (y down)."""
    flip = np.diag([1.0, -1.0, -1.0])
    headings = 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS
    about = matrix_from_rotvec(headings[:, None] * np.array([0.0, 1.0, 0.0]))
    tilts = matrix_from_rotvec(np.radians(TILTS)[:, None] * np.array([1.0, 0.0, 0.0]))
    return (tilts[:, None] @ (flip @ about)[None]).reshape(-1, 3, 3)


def _angles(turns: Float[np.ndarray, "H 3 3"]) -> Float[np.ndarray, "H H"]:
    """Between all pairs (rad)."""
    trace = np.einsum("aij,bij->ab", turns, turns)
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def _place(
    points: Float[np.ndarray, "K 3"],
    plane: Float[np.ndarray, "T K 2"],
    weight: Float[np.ndarray, "T K"],
    height: float,
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, " T"]]:
    """Where a turned body is in the camera's frame (m), and what keypoints cost there."""
    rows = np.zeros((*plane.shape, 3))
    rows[..., 0, 0] = rows[..., 1, 1] = 1.0
    rows[..., 2] = -plane
    right = plane * points[:, 2:] - points[:, :2]
    normal = np.einsum("tk,tkui,tkuj->tij", weight, rows, rows) + 1e-9 * np.eye(3)
    place = np.linalg.solve(normal, np.einsum("tk,tkui,tku->ti", weight, rows, right)[..., None])
    place = place[..., 0]
    off = np.einsum("tkui,ti->tku", rows, place) - right  # metres at the person's distance
    squared = (off**2).sum(-1) / (MISFIT * height) ** 2
    cost = 0.5 * (weight * squared / (1.0 + squared / 9.0)).sum(1)
    return place, np.where(place[:, 2] > 0.3, cost, 1e6)


def _cheapest(
    costs: Float[np.ndarray, "T H"], angles: Float[np.ndarray, "H H"]
) -> Int[np.ndarray, " T"]:
    """The path of least cost, ``TURN`` a radian between frames."""
    step = TURN * angles
    total = costs[0]
    back = np.zeros(costs.shape, int)
    for t in range(1, len(costs)):
        way = total[None] + step
        back[t] = way.argmin(1)
        total = way[np.arange(len(step)), back[t]] + costs[t]
    path = np.empty(len(costs), int)
    path[-1] = total.argmin()
    for t in range(len(costs) - 1, 0, -1):
        path[t - 1] = back[t, path[t]]
    return path


def standing_points(
    camera: RigCamera,
    pixels: Float[np.ndarray, "T K 2"],
    size: Float[np.ndarray, " T"],
    names: tuple[str, ...],
    person: ShapedKeypoints,
    upright: Float[np.ndarray, "3 3"],
    floor: float,
    rate_hz: float,
) -> Float[np.ndarray, "T K 3"]:
    """Where heels and toes are (m) while they stand still in the image: on the ray of their pixel,
    as high above the floor as on the person at rest; NaN elsewhere. size: the person's height in
    pixels; upright: the rotation that makes the world's vertical y; floor: its height there (m).
    """
    out = np.full((*pixels.shape[:2], 3), np.nan)
    rest = person.points(np.zeros((1, len(person.joints), 3)), np.zeros((1, 3)))[0]
    up = upright[1]
    step = max(1, round(STILL_SECONDS * rate_hz / 2.0))
    for k, name in enumerate(names):
        if not any(part in name for part in FOOT):
            continue
        moved = np.full(len(pixels), np.inf)
        way = np.linalg.norm(pixels[2 * step :, k] - pixels[: -2 * step, k], axis=-1)
        moved[step:-step] = way / size[step:-step] * PERSON_HEIGHT * rate_hz / (2 * step)
        plane = (pixels[:, k] - camera.centre) / camera.focal
        ray = np.concatenate([plane, np.ones((len(plane), 1))], 1) @ camera.rotation
        height = floor + rest[k, 1] - rest[:, 1].min() + SOLE
        with np.errstate(all="ignore"):
            along = (height - camera.place @ up) / (ray @ up)
        still = (moved < STILL_SPEED) & (along > 0.3)
        out[still, k] = camera.place + along[still, None] * ray[still]
    return out
