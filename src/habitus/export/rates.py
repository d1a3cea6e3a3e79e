"""A motion resampled at another rate: every n-th frame where that fits, else interpolated between
two frames.
"""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.io.captures.read import SLOWEST_HZ
from habitus.parallel.blocks import mapped

if TYPE_CHECKING:
    from habitus.body.motion import Moving

FASTEST = 1e4


def at_rate(moving: "Moving", fps: float | None) -> "Moving":
    """The motion at ``fps`` frames a second from its first frame on, as long as it lasts; as it is
    with None.

    Between two frames joints turn on the shortest way and all else moves on a straight line. Raises
    HabitusError for a rate that is none.
    """
    if fps is None or fps == moving.rate_hz:
        return moving
    if not SLOWEST_HZ <= fps <= FASTEST:
        raise HabitusError(
            f"fps is {fps:g}; expected {SLOWEST_HZ:g} to {FASTEST:g} frames a second"
        )
    motion = BodyMotion.of(moving)
    last = len(motion.pose) - 1
    places = np.arange(int(np.floor(last * fps / motion.rate_hz + 1e-6)) + 1) * (
        motion.rate_hz / fps
    )
    places = np.minimum(places, last)
    before = np.minimum(np.floor(places + 1e-6).astype(np.int64), max(last - 1, 0))
    part = np.where(np.abs(places - before) < 1e-6, 0.0, places - before)
    after = np.minimum(before + 1, last)
    return replace(
        motion,
        pose=mapped(partial(_turned, np.asarray(motion.pose)), before, after, part),
        trans=_between(motion.trans, before, after, part),
        soft_tissue=None
        if motion.soft_tissue is None
        else _between(motion.soft_tissue, before, after, part),
        dynamics=None
        if motion.dynamics is None
        else _between(motion.dynamics, before, after, part),
        face=None if motion.face is None else _between(motion.face, before, after, part),
        rate_hz=float(fps),
    )


def _between(
    values: np.ndarray, before: np.ndarray, after: np.ndarray, part: np.ndarray
) -> np.ndarray:
    first = np.asarray(values[before], np.float64)
    return first + part[:, None] * (values[after] - first)


def _turned(
    pose: Float[np.ndarray, "T J 3"], before: np.ndarray, after: np.ndarray, part: np.ndarray
) -> Float[np.ndarray, "N J 3"]:
    first = np.asarray(pose[before], np.float64)
    if not part.any():
        return first
    start = Rotation.from_rotvec(first.reshape(-1, 3))
    way = (start.inv() * Rotation.from_rotvec(pose[after].reshape(-1, 3))).as_rotvec()
    share = np.repeat(part, pose.shape[1])[:, None]
    return (start * Rotation.from_rotvec(share * way)).as_rotvec().reshape(first.shape)
