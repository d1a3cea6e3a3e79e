"""Dynamic blend shapes, and the regressor that predicts their coefficients from motion (DMPL: S 6,
eqs. 16 and 17).

The motion that drives them (phi_t of S 6 without its history) are velocities and accelerations of
the body's joints, in frames that move with the body, so that its position and heading do not
matter. Differences are central: frame t is compared with the one before and the one after. Before
its first and after its last frame a body is taken to move as steadily as between the two nearest.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.kernels import joint_motions
from habitus.errors import HabitusError
from habitus.rotations import rotvec_from_matrix

REST_SECONDS = 2.0
"""Soft tissue of a body that has stopped moving is at rest after so long,"""
REST_SHARE = 0.01
"""which is when this share of it is left."""


@dataclass(frozen=True, eq=False)
class DynamicsRegressor:
    """f of S eq. 17: D coefficients from those of the last two frames and from what joints do,
    linear in both.

        delta_t = A_1 delta_{t-1} + A_2 delta_{t-2} + B u_t;   A_1, A_2, B = X_0 + sum_s betas_s X_s

    ``history`` holds A_1 and A_2, ``drive`` B, as blocks X_0, X_1, ..., X_S. The C controls u_t are
    of the kind ``controls`` (`habitus.body.dynamics`) and of these ``joints``, at
    ``rate_hz``: the rate that was learned. Controls are cut off at ``limits`` (C,), betas at
    ``reach`` (2, S): the regressor knows nothing of what lies beyond. There is no constant: a body
    at rest has no soft tissue in motion. Raises HabitusError where these do not fit together.
    """

    history: Float[np.ndarray, "S1 2 D D"]
    drive: Float[np.ndarray, "S1 D C"]
    joints: tuple[str, ...]
    rate_hz: float
    limits: Float[np.ndarray, " C"]
    reach: Float[np.ndarray, "2 S"]
    controls: str = "joints"

    def __post_init__(self) -> None:
        if self.controls not in CONTROLS:
            raise HabitusError(
                f"controls are {self.controls!r}; expected one of {', '.join(CONTROLS)}"
            )
        if not 1.0 <= self.rate_hz <= 1e5:
            raise HabitusError(
                f"dynamics were learned at {self.rate_hz:g} Hz; expected 1 to 100,000"
            )
        blocks = self.drive.shape[0]
        count = CONTROLS[self.controls].count(len(self.joints))
        expected = {
            "history": (blocks, 2, *2 * self.drive.shape[1:2]),
            "drive": (blocks, self.drive.shape[1], count),
            "limits": (count,),
            "reach": (2, blocks - 1),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise HabitusError(
                    f"dynamics' {name} has shape {getattr(self, name).shape}; expected {shape}"
                )

    @property
    def count(self) -> int:
        """D."""
        return self.drive.shape[1]

    def of_person(self, betas: Float[np.ndarray, " B"]) -> tuple[np.ndarray, np.ndarray]:
        """The history (2, D, D) and the drive (D, C) of a person of this shape; the history is
        `at_rest_in_time`.
        """
        known = self.drive.shape[0] - 1
        shape = np.zeros(known)
        shape[: len(betas)] = np.asarray(betas, np.float64)[:known]
        factors = np.concatenate([[1.0], np.clip(shape, *self.reach)])
        return at_rest_in_time(np.tensordot(factors, self.history, 1), self.rate_hz), np.tensordot(
            factors, self.drive, 1
        )


@dataclass(frozen=True, eq=False)
class Dynamics:
    """What a body knows of soft tissue in motion: blend shapes, and what predicts their
    coefficients.

    ``directions`` are in metres for a coefficient of 1, which is its root mean square over the
    motions that were learned. They are added to the rest surface and move no joint (S eq. 16).
    """

    directions: Float[np.ndarray, "V 3 D"]
    regressor: DynamicsRegressor

    def __post_init__(self) -> None:
        object.__setattr__(self, "directions", np.asarray(self.directions, np.float64, order="C"))
        if self.directions.ndim != 3 or self.directions.shape[2] != self.regressor.count:
            raise HabitusError(
                f"dynamic blend shapes have shape {self.directions.shape}; expected (V, 3, "
                f"{self.regressor.count})"
            )

    def scaled(self, factor: float) -> "Dynamics":
        """Of a body that is larger by a factor."""
        return replace(self, directions=factor * self.directions)


def at_rest_in_time(
    history: Float[np.ndarray, "2 D D"], rate_hz: float
) -> Float[np.ndarray, "2 D D"]:
    """The history, damped where its slowest mode would take longer than `REST_SECONDS` to die down
    to `REST_SHARE`.

    A_1 and A_2 times s and s^2 have all modes times s, so that nothing else of the motion changes.
    Every person's history passes through here: whatever was learned, and for whatever shape, soft
    tissue stays bounded.
    """
    most = REST_SHARE ** (1.0 / (REST_SECONDS * rate_hz))
    radius = float(np.abs(np.linalg.eigvals(companion(history))).max(initial=0.0))
    shrink = min(1.0, most / radius) if radius > 0.0 else 1.0
    return history * np.array([shrink, shrink**2])[:, None, None]


def companion(history: Float[np.ndarray, "2 D D"]) -> Float[np.ndarray, "E E"]:
    """The matrix that takes two frames' coefficients (delta_{t-1}, delta_{t-2}) to the next two; E
    = 2 D.
    """
    count = history.shape[-1]
    return np.block([[history[0], history[1]], [np.eye(count), np.zeros((count, count))]])


def free_run(
    history: Float[np.ndarray, "2 D D"],
    pushes: Float[np.ndarray, "T D"],
    start: Float[np.ndarray, "2 D"] | None = None,
) -> Float[np.ndarray, "T D"]:
    """Coefficients of T frames from what pushes them, B u_t; ``start``: of the two frames before,
    the later first.
    """
    count = history.shape[-1]
    step = np.concatenate(list(history), axis=1)
    state = np.zeros(2 * count)
    if start is not None:
        state[:] = np.ravel(start)
    states = np.empty_like(pushes)
    for t, push in enumerate(pushes):
        now = step @ state + push
        states[t] = now
        state[count:] = state[:count]
        state[:count] = now
    return states


_BLOCK = 4096  # frames worked on together


@dataclass(frozen=True, eq=False)
class _Skeletons:
    """Posed skeletons of T frames: rotations of all joints against their parents, and in the world,
    and places (m).
    """

    turns: Float[np.ndarray, "T J 3 3"]
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
        controls = CONTROLS[kind].of(
            _skeletons(rest_joints, parents, pose[some], trans[some]), joints, rate_hz
        )
        blocks.append(controls[before : before + last - first])
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
    turned = [each.reshape(len(root), -1) for each in _turning(skeletons.turns[:, joints], rate_hz)]
    return np.concatenate([*turned, *moved], axis=-1)


def _turning(
    rotations: Float[np.ndarray, "T J 3 3"], rate_hz: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity (rad/s) and acceleration (rad/s^2) in the frame that turns."""
    return _differences(
        rotvec_from_matrix(rotations[:-1].swapaxes(-1, -2) @ rotations[1:]), rate_hz
    )


def _differences(
    steps: Float[np.ndarray, " S *n"], rate_hz: float
) -> tuple[np.ndarray, np.ndarray]:
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
