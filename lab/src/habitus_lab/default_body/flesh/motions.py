"""Real motions to shake flesh with: fitted captures at one rate, smoothed, cut into pieces that
start anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from habitus.errors import HabitusError
from habitus.rotations import quaternion_from_rotvec, rotvec_from_quaternion

from .poses import mirrored_pose

RATE = 60.0
SMOOTH = 0.012  # s: standard deviation of the filter that takes the captures' noise out, 13 Hz
PIECE = 300  # frames that are kept of a piece
SETTLE = 15
SHORTEST = 60  # frames before those, in which flesh starts moving; shorter ends are left out
BODY_JOINTS = 22
LEVER = 0.2
FASTEST = 40.0  # m, m/s^2


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch of a motion: poses (T, J, 3) and trans (T, 3) at `RATE`; the first `SETTLE` frames
    are not kept.
    """

    name: str
    poses: np.ndarray
    trans: np.ndarray

    @property
    def vigour(self) -> float:
        """Root mean square (m/s^2) of the root's acceleration and of the joints' at the end of a
        `LEVER`.
        """
        turns = LEVER * np.diff(self.poses[:, :BODY_JOINTS], 2, axis=0) * RATE**2
        turns = np.clip(turns, -FASTEST, FASTEST)  # a rotation vector that wraps is no motion
        return float(
            np.sqrt((turns**2).mean() + (np.diff(self.trans, 2, axis=0) ** 2).mean() * RATE**4)
        )


def pieces(path: Path, joint_names: tuple[str, ...], mirrored: bool = False) -> list[Piece]:
    """The pieces of a fitted motion (npz with AMASS' arrays). Raises HabitusError for other
    files.
    """
    try:
        with np.load(path, allow_pickle=False) as found:
            poses = found["poses"]
            trans = found["trans"]
            rate = float(found["mocap_framerate"])
    except (OSError, ValueError, KeyError) as error:
        raise HabitusError(
            f"{path}: no poses, trans and mocap_framerate in it; expected a fitted motion"
        ) from error
    poses = poses.reshape(len(poses), -1, 3)[:, :BODY_JOINTS]
    turns = quaternion_from_rotvec(poses.astype(float))
    for t in range(1, len(turns)):
        turns[t] *= np.where((turns[t] * turns[t - 1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    count = int((len(poses) - 1) * RATE / rate) + 1
    when = np.linspace(0, (count - 1) * rate / RATE, count)
    full = np.zeros((count, len(joint_names), 3))
    full[:, :BODY_JOINTS] = rotvec_from_quaternion(_resampled(turns, when, rate))
    place = _resampled(trans.astype(float), when, rate)
    name = path.parent.name if path.stem == "body" else path.stem
    if mirrored:
        name = f"{name}_m"
        full = _mirrored(full, joint_names)
        place = place * [-1, 1, 1]
    starts = range(0, max(0, count - SETTLE - SHORTEST), PIECE)
    return [
        Piece(
            f"{name}_{k:03d}",
            full[first : first + SETTLE + PIECE],
            place[first : first + SETTLE + PIECE],
        )
        for k, first in enumerate(starts)
    ]


def _resampled(values: np.ndarray, when: np.ndarray, rate: float) -> np.ndarray:
    """Values (T, ...) at other moments (in frames), smoothed."""
    smooth = gaussian_filter1d(values, SMOOTH * rate, axis=0, mode="nearest")
    low = np.minimum(when.astype(int), len(values) - 2)
    share = (when - low).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - share) * smooth[low] + share * smooth[low + 1]


def _mirrored(poses: np.ndarray, joint_names: tuple[str, ...]) -> np.ndarray:
    return np.stack([mirrored_pose(pose, joint_names) for pose in poses])
