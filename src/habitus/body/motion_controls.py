"""What drives soft tissue: velocities and accelerations of a moving body's joints (S 6's phi_t
without its history).

Differences are central: frame t is held against the one before and the one after. A body stands and
turns as steadily before its first and after its last frame as between the two nearest. All are in
frames that go along with the body, so that it does not matter where the body is and which way it
faces.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.kernels import joint_motions
from habitus.rotations import rotvec_from_matrix

_BLOCK = 4096  # frames worked on together


@dataclass(frozen=True, eq=False)
class _Skeletons:
    """Posed skeletons of T frames: own rotations, rotations in the world, and places (m), of all
    joints.
    """

    own: Float[np.ndarray, "T J 3 3"]
    world: Float[np.ndarray, "T J 3 3"]
    places: Float[np.ndarray, "T J 3"]


@dataclass(frozen=True)
class Controls:
    """A kind of controls: how many there are for so many joints, and what they are for certain
    joints.
    """

    count: Callable[[int], int]
    of: Callable[[_Skeletons, list[int], float], Float[np.ndarray, "T C"]]


def motion_controls(
    kind: str,
    joints: list[int],
    parents: tuple[int, ...],
    rest_joints: Float[np.ndarray, "J 3"],
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    rate_hz: float,
) -> Float[np.ndarray, "T C"]:
    """Controls, of a kind in `CONTROLS`, of some joints in T frames of a motion (rad, m)."""
    if len(pose) < 3:
        return np.zeros((len(pose), CONTROLS[kind].count(len(joints))))
    blocks = []
    for first in range(0, len(pose), _BLOCK):
        last = min(first + _BLOCK, len(pose))
        before = min(first, 1)
        after = min(len(pose) - last, 1)  # neighbours, dropped again
        some = slice(first - before, last + after)
        found = CONTROLS[kind].of(
            _skeletons(rest_joints, parents, pose[some], trans[some]), joints, rate_hz
        )
        blocks.append(found[before : before + last - first])
    return np.concatenate(blocks)


def _skeletons(
    rest_joints: np.ndarray, parents: tuple[int, ...], pose: np.ndarray, trans: np.ndarray
) -> _Skeletons:
    motions, places, entries = joint_motions(
        np.asarray(pose, np.float64), np.asarray(rest_joints, np.float64)[None], np.array(parents)
    )
    frames, count = motions.shape[:2]
    own = entries.reshape(frames, count, 3, 3) + np.eye(3)
    return _Skeletons(own, motions.reshape(frames, count, 3, 4)[..., :3], places + trans[:, None])


def _joints(skeletons: _Skeletons, joints: list[int], rate_hz: float) -> np.ndarray:
    """Of each joint, in its own frame: linear acceleration, angular velocity, angular acceleration.

    These are what a bone does to the flesh that hangs on it. A steady linear velocity does nothing
    to it.
    """
    world = skeletons.world[:, joints]
    _, acceleration = _differences(np.diff(skeletons.places[:, joints], axis=0), rate_hz)
    spin, spin_up = _turning(world, rate_hz)
    own = (world.swapaxes(-1, -2) @ acceleration[..., None])[..., 0]
    return np.concatenate([own, spin, spin_up], axis=-1).reshape(len(world), -1)


def _smpl(skeletons: _Skeletons, joints: list[int], rate_hz: float) -> np.ndarray:
    """S 6: each joint's turning against its parent, velocities then accelerations, and the root's
    velocity and acceleration, here in its own frame.
    """
    velocity, acceleration = _differences(np.diff(skeletons.places[:, 0], axis=0), rate_hz)
    root = skeletons.world[:, 0].swapaxes(-1, -2)
    moved = [(root @ each[..., None])[..., 0] for each in (velocity, acceleration)]
    turned = [each.reshape(len(root), -1) for each in _turning(skeletons.own[:, joints], rate_hz)]
    return np.concatenate([*turned, *moved], axis=-1)


def _turning(
    rotations: Float[np.ndarray, "T J 3 3"], rate_hz: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity (rad/s) and acceleration (rad/s^2) in the frame that turns."""
    return _differences(
        rotvec_from_matrix(rotations[:-1].swapaxes(-1, -2) @ rotations[1:]), rate_hz
    )


def _differences(steps: Float[np.ndarray, "S *n"], rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and acceleration in T = S + 1 frames from the S steps between them; steady at both
    ends.
    """
    steps = np.concatenate([steps[:1], steps, steps[-1:]])
    return 0.5 * rate_hz * (steps[1:] + steps[:-1]), rate_hz**2 * np.diff(steps, axis=0)


CONTROLS = {
    "joints": Controls(lambda joints: 9 * joints, _joints),
    "smpl": Controls(lambda joints: 6 * joints + 6, _smpl),
}
"""Kinds of controls."""


def resampled(
    values: Float[np.ndarray, "T C"], rate_hz: float, to_hz: float
) -> Float[np.ndarray, "K C"]:
    """The same course at another rate, from the first frame on to the last.

    A higher rate is reached by straight lines, a lower one by means over its own frames' time: what
    is pushed in between is not lost. The same rate changes nothing.
    """
    if abs(rate_hz - to_hz) <= 1e-6 * to_hz or len(values) < 2:
        return values
    at = np.arange(int((len(values) - 1) * to_hz / rate_hz + 1e-9) + 1) * (rate_hz / to_hz)
    if to_hz > rate_hz:
        return at_frames(values, at)
    summed = np.concatenate(
        [np.zeros((1, *values.shape[1:])), np.cumsum(0.5 * (values[1:] + values[:-1]), axis=0)]
    )
    half = 0.5 * rate_hz / to_hz
    last = len(values) - 1.0
    begin = np.maximum(at - half, 0.0)
    end = np.minimum(at + half, last)
    return (at_frames(summed, end) - at_frames(summed, begin)) / (end - begin)[:, None]


def at_frames(
    values: Float[np.ndarray, "T C"], places: Float[np.ndarray, " K"]
) -> Float[np.ndarray, "K C"]:
    """Between frames on straight lines; behind the last frame as there."""
    below = np.minimum(places.astype(np.int64), max(len(values) - 2, 0))
    share = np.minimum(places - below, 1.0)[:, None]
    return (1.0 - share) * values[below] + share * values[np.minimum(below + 1, len(values) - 1)]
