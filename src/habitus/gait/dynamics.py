"""Newton's and Euler's equations of a body's parts: the force that a motion needs, what force
plates lack of it, and the moments of joints.

    F_needed = sum_i m_i (a_i - g)
    M_J = sum_{i below J} [(c_i - p_J) x m_i (a_i - g) + d/dt (I_i w_i)]
          - sum_k [(r_k - p_J) x F_k + T_k]

i: parts with centres c_i; k: contacts below J with force F_k at r_k and free moment T_k; p_J: the
joint's centre. M_J is what the upper segment does to the lower one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from habitus.gait.contacts import ForcePlate
from habitus.gait.events import lowpass

GRAVITY = 9.81
MOTION_HZ = 6.0
"""Cut-off of the motion's low-pass filter, and"""
FORCE_HZ = 20.0
"""of the plates'."""


@dataclass(frozen=True, eq=False)
class Loads:
    """What moves parts: for each of J, over T frames, the force m (a - g) (N) at its centre (m) and
    the rate of its spin I w (Nm).
    """

    force: Float[np.ndarray, "T J 3"]
    centre: Float[np.ndarray, "T J 3"]
    spin: Float[np.ndarray, "T J 3"]

    @property
    def needed(self) -> Float[np.ndarray, "T 3"]:
        """From outside (N)."""
        return self.force.sum(1)


@dataclass(frozen=True, eq=False)
class GroundForces:
    """One contact over the motion's T frames, zero where there is none: force (N), place (m) and
    free moment (Nm).
    """

    force: Float[np.ndarray, "T 3"]
    place: Float[np.ndarray, "T 3"]
    moment: Float[np.ndarray, "T 3"]


def loads(
    mass: Float[np.ndarray, " J"],
    inertia: Float[np.ndarray, "J 3 3"],
    centre: Float[np.ndarray, "T J 3"],
    turn: Float[np.ndarray, "T J 3 3"],
    rate_hz: float,
    up: Float[np.ndarray, "3"],
    cutoff_hz: float = MOTION_HZ,
) -> Loads:
    """The loads of J parts from their motion over T frames. mass: kg; inertia: about the centre, in
    the axes of rest (kg m^2); centre: m, world; turn: rotations from rest to the world; up: unit
    vector against gravity; cutoff_hz: of the low-pass filter.
    """
    smooth = lowpass(centre, rate_hz, cutoff_hz)
    acceleration = np.gradient(np.gradient(smooth, axis=0), axis=0) * rate_hz**2
    acceleration[1:-1] = np.diff(smooth, 2, axis=0) * rate_hz**2
    force = mass[:, None] * (acceleration + GRAVITY * up)
    spin = lowpass(angular_velocity(turn, rate_hz), rate_hz, cutoff_hz)
    world = np.einsum("tjab,jbc,tjdc->tjad", turn, inertia, turn)
    momentum = np.einsum("tjab,tjb->tja", world, spin)
    return Loads(force, smooth, np.gradient(momentum, axis=0) * rate_hz)


def angular_velocity(
    turn: Float[np.ndarray, "T J 3 3"], rate_hz: float
) -> Float[np.ndarray, "T J 3"]:
    """rad/s in the world, from central differences of rotations."""
    ahead = np.concatenate([turn[1:], turn[-1:]])
    behind = np.concatenate([turn[:1], turn[:-1]])
    steps = np.full(len(turn), 2.0)
    steps[[0, -1]] = 1.0
    way = Rotation.from_matrix((ahead @ behind.swapaxes(-1, -2)).reshape(-1, 3, 3)).as_rotvec()
    return way.reshape(*turn.shape[:2], 3) * (rate_hz / steps)[:, None, None]


def ground_forces(
    plate: ForcePlate,
    start: float,
    end: float,
    frames: int,
    rate_hz: float,
    cutoff_hz: float = FORCE_HZ,
) -> GroundForces:
    """A plate's forces between two times (s) at the motion's frames, low-passed."""
    at = np.arange(frames) / rate_hz
    rows = np.arange(len(plate.force)) / plate.rate_hz
    inside = (rows >= start) & (rows <= end)
    force = np.where(inside[:, None], plate.force, 0.0)
    free = np.where(inside[:, None], plate.free_moment, 0.0)
    place = np.where(inside[:, None], plate.pressure, np.nan)
    known = np.isfinite(place[:, 0])
    middle = plate.corners.mean(0)
    if known.any():
        place = np.stack([np.interp(rows, rows[known], column[known]) for column in place.T], 1)
    else:
        place = np.broadcast_to(middle, force.shape)
    turned = lowpass(np.cross(place - middle, force) + free, plate.rate_hz, cutoff_hz)
    force = lowpass(force, plate.rate_hz, cutoff_hz)

    def resampled(values: np.ndarray) -> Float[np.ndarray, "T 3"]:
        return np.stack([np.interp(at, rows, c, 0.0, 0.0) for c in values.T], 1)

    return GroundForces(resampled(force), np.broadcast_to(middle, (frames, 3)), resampled(turned))


def residual(own: Loads, ground: Sequence[GroundForces]) -> Float[np.ndarray, "T 3"]:
    """What the plates measure beyond what the motion needs (N); zero of a true motion all of whose
    contacts are on plates.
    """
    total = np.zeros_like(own.needed)
    for contact in ground:
        total = total + contact.force
    return total - own.needed


def joint_moment(
    own: Loads,
    below: Bool[np.ndarray, " J"],
    joint: Float[np.ndarray, "T 3"],
    ground: Sequence[GroundForces],
) -> Float[np.ndarray, "T 3"]:
    """The moment (Nm, world) that the segment above a joint exerts on what lies below it. below:
    parts that hang on the joint; ground: contacts of these.
    """
    arm = own.centre[:, below] - joint[:, None]
    moment = (np.cross(arm, own.force[:, below]) + own.spin[:, below]).sum(1)
    for contact in ground:
        moment = moment - np.cross(contact.place - joint, contact.force) - contact.moment
    return moment
