"""Poses for planted registrations: sampled within the limits of human joints, or taken from fitted
motions.

Rotation vectors (rad) relative to the parent, in a body that rests in the T-pose, y up, facing +z,
x to its left.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError
from habitus_lab.population.coarse_bodies import mirrored_names

# joint of the middle or the left: lowest and highest rotation about x, y and z, degrees; the right
# mirrors y and z
HUMAN_LIMITS: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "pelvis": ((-25, 25), (-40, 40), (-20, 20)),
    "hip": ((-100, 20), (-30, 30), (-15, 40)),
    "knee": ((0, 140), (-8, 8), (-3, 3)),
    "ankle": ((-25, 45), (-15, 15), (-18, 18)),
    "foot": ((-50, 25), (-4, 4), (-4, 4)),
    "spine1": ((-15, 35), (-15, 15), (-15, 15)),
    "spine2": ((-12, 25), (-15, 15), (-12, 12)),
    "spine3": ((-12, 25), (-18, 18), (-12, 12)),
    "neck": ((-25, 35), (-40, 40), (-22, 22)),
    "head": ((-25, 25), (-40, 40), (-18, 18)),
    "collar": ((-8, 8), (-22, 12), (-12, 30)),
    "shoulder": ((-40, 40), (-90, 30), (-75, 50)),
    "elbow": ((-40, 40), (-135, 0), (-4, 4)),
    "wrist": ((-25, 25), (-20, 30), (-65, 55)),
    "hand": ((-8, 8), (-12, 12), (-75, 10)),
}
TOGETHER = (
    ("spine1", "spine2", "spine3"),
    ("neck", "head"),
    ("collar", "shoulder"),
    ("ankle", "foot"),
)
COMMON = (
    0.6  # share of a joint's place within its limits that joints which move together have in common
)
STRONG = 0.4
SLIGHT = 0.15  # how often a joint moves strongly, and how far the others go
SYMMETRIC = 0.3  # how often the right side does as the left
BALL = 0.9  # rad: rotations of joints without limits are uniform in a ball of this radius
RESTING = 0.08  # how far joints go in poses near rest, as a share of their limits
ARMS_DOWN = np.radians(50.0)  # of an A-pose's shoulders
SMPL_H_JOINTS = 22  # joints at the head of longer skeletons' poses that are SMPL's own


@dataclass(frozen=True)
class JointLimits:
    """Limits of J joints (rad): ``low`` to ``high`` about each axis, or anywhere in a ball where
    these are NaN.

    ``mirror`` is the joint on the other side, ``group`` numbers joints that move together,
    ``arms_down`` is the pose that makes an A-pose of a T-pose.
    """

    low: Float[np.ndarray, "J 3"]
    high: Float[np.ndarray, "J 3"]
    mirror: Int[np.ndarray, " J"]
    group: Int[np.ndarray, " J"]
    arms_down: Float[np.ndarray, "J 3"]


def joint_limits(joint_names: tuple[str, ...]) -> JointLimits:
    """Limits by SMPL's joint names (left_, right_ and the part); a joint of another name may turn
    within a ball.
    """
    low, high = np.full((2, len(joint_names), 3), np.nan)
    groups: dict[str, int] = {}
    group = np.zeros(len(joint_names), dtype=int)
    arms_down = np.zeros((len(joint_names), 3))
    for k, name in enumerate(joint_names):
        side, _, part = name.rpartition("_")
        if part in HUMAN_LIMITS and side in ("", "left", "right"):
            low[k], high[k] = np.radians(np.array(HUMAN_LIMITS[part], dtype=float).T)
            if side == "right":
                low[k, 1:], high[k, 1:] = -high[k, 1:], -low[k, 1:]
        arms_down[k, 2] = {"left_shoulder": -ARMS_DOWN, "right_shoulder": ARMS_DOWN}.get(name, 0.0)
        moves = next((parts[0] for parts in TOGETHER if part in parts), part)
        group[k] = groups.setdefault(f"{side}_{moves}", len(groups))
    return JointLimits(low, high, mirrored_names(joint_names), group, arms_down)


def sample_poses(
    rng: np.random.Generator, count: int, limits: JointLimits
) -> Float[np.ndarray, "N J 3"]:
    """Poses (rad) within the limits: some joints turn strongly, the rest a little; neighbours and
    sides go together.
    """
    joints = len(limits.group)
    strong = (rng.random((count, joints)) < STRONG)[
        :, limits.group
    ]  # a group is strong or slight as a whole
    share = rng.random((count, joints, 3))[:, limits.group] * COMMON + rng.random(
        (count, joints, 3)
    ) * (1 - COMMON)
    pose = (limits.low + (limits.high - limits.low) * share) * np.where(strong, 1.0, SLIGHT)[
        ..., None
    ]
    free = np.isnan(pose).any(-1)
    direction = rng.standard_normal((count, joints, 3))
    direction *= (
        BALL * rng.random((count, joints)) ** (1 / 3) / np.linalg.norm(direction, axis=-1)
    )[..., None]
    pose[free] = direction[free]
    return _copy_left(pose, limits, rng.random(count) < SYMMETRIC)


def resting_poses(
    rng: np.random.Generator, count: int, limits: JointLimits
) -> Float[np.ndarray, "N J 3"]:
    """Poses near the T-pose, every second with the arms half down (an A-pose), as people stand to
    be scanned.
    """
    pose = sample_poses(rng, count, limits) * RESTING
    pose[::2] += limits.arms_down
    return pose


def motion_poses(
    paths: Iterable[str | os.PathLike[str]], count: int, joints: int, *, candidates: int = 4000
) -> Float[np.ndarray, "N J 3"]:
    """``count`` poses (rad) far from one another out of fitted motions: npz files with AMASS' array
    ``poses`` (T, 3 J).

    Of longer skeletons (SMPL-H, SMPL-X) the 22 joints that SMPL shares are taken, and the hands
    left at rest. The root does not turn. Farthest points first, among ``candidates`` frames. Raises
    HabitusError, with the file named, where there is no such array, or where all files together
    have fewer frames than asked for.
    """
    paths = list(paths)
    poses = (
        np.concatenate([_motion(path, joints) for path in paths])
        if paths
        else np.zeros((0, joints, 3))
    )
    if len(poses) < count:
        raise HabitusError(
            f"{len(poses)} frames in {len(paths)} motions; expected at least {count}: give more "
            "motions"
        )
    poses = poses[
        np.unique(np.linspace(0, len(poses) - 1, max(candidates, count)).round().astype(int))
    ]
    flat = poses.reshape(len(poses), -1)
    chosen = [int(np.argmax((flat**2).sum(1)))]
    nearest = ((flat - flat[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((flat - flat[chosen[-1]]) ** 2).sum(1))
        nearest[chosen] = -1.0
    return poses[chosen]


def _motion(path: str | os.PathLike[str], joints: int) -> Float[np.ndarray, "T J 3"]:
    try:
        with np.load(path, allow_pickle=False) as file:
            poses = np.asarray(file["poses"], dtype=float)
    except (OSError, ValueError, KeyError) as error:
        raise HabitusError(
            f"{os.fspath(path)}: no array 'poses' can be read; expected an npz of a fitted motion"
        ) from error
    if poses.ndim == 2 and poses.shape[1] % 3 == 0:
        poses = poses.reshape(len(poses), -1, 3)
    known = joints if poses.ndim == 3 and poses.shape[1] == joints else min(joints, SMPL_H_JOINTS)
    if poses.ndim != 3 or poses.shape[1] < known or not np.isfinite(poses).all():
        raise HabitusError(
            f"{os.fspath(path)}: poses have shape {poses.shape}; expected finite numbers (T, 3 x "
            f"{joints})"
        )
    kept = np.zeros((len(poses), joints, 3))
    kept[:, 1:known] = poses[:, 1:known]
    return kept


def _copy_left(pose: np.ndarray, limits: JointLimits, which: np.ndarray) -> np.ndarray:
    """The right side as the mirrored left in ``which`` poses; the joint later in the tree of a pair
    is the right.
    """
    right = np.flatnonzero(limits.mirror < np.arange(len(limits.mirror)))
    mirrored = pose[:, limits.mirror[right]] * np.array([1.0, -1.0, -1.0])
    pose[:, right] = np.where(which[:, None, None], mirrored, pose[:, right])
    return pose
