"""Soft tissue of a body in motion, predicted from how it moves (DMPL: S 6)."""

import numpy as np
from jaxtyping import Float

from habitus.arrays import kind_of, to_numpy
from habitus.body.dynamics import Dynamics, free_run
from habitus.body.model import BodyModel
from habitus.body.motion_controls import at_frames, motion_controls, resampled
from habitus.errors import HabitusError
from habitus.types import Array, ArrayLike

SLOWEST_HZ = 10.0
"""Below this rate frames tell nothing of accelerations."""


def simulate_soft_tissue(
    body: BodyModel,
    betas: ArrayLike,
    pose: ArrayLike,
    trans: ArrayLike,
    rate: float,
    strength: float = 1.0,
) -> Float[Array, "T D"]:
    """Coefficients of the dynamic blend shapes for T frames of any motion, to be given to ``body(…,
    dynamics=…)``.

    ``betas`` (B,) or fewer, ``pose`` (T, J, 3) in rad, ``trans`` (T, 3) in m, ``rate`` in frames a
    second: of a fit, of a motion that is retargeted to this shape, of any file. The body begins at
    rest. ``strength`` exaggerates (above 1) or weakens what moves. The regressor runs at the rate
    that it was learned at; at other rates the joints' velocities and accelerations are brought
    there (`resampled`) and its coefficients back, on straight lines. What is faster than anything
    that was learned (a jump in the data) counts as the fastest. Answers in the kind of what it is
    given.

    Raises HabitusError for a body without dynamic blend shapes, and for motions that are none.
    """
    dynamics = dynamics_of(body)
    kind = kind_of(betas, pose, trans)
    shape, poses, places = (to_numpy(each, np.float64) for each in (betas, pose, trans))
    _check(body, shape, poses, places, rate)
    regressor = dynamics.regressor
    history, drive = regressor.of_person(shape)
    controls = resampled(
        controls_of(body, dynamics, shape, poses, places, rate), rate, regressor.rate_hz
    )
    found = free_run(history, np.clip(controls, -regressor.limits, regressor.limits) @ drive.T)
    if len(found) != len(poses) or rate != regressor.rate_hz:
        found = at_frames(found, np.arange(len(poses)) * (regressor.rate_hz / rate))
    return kind.array(strength * found)


def controls_of(
    body: BodyModel,
    dynamics: Dynamics,
    betas: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
    rate: float,
) -> Float[np.ndarray, "T C"]:
    """The controls that the body's regressor goes by, at the motion's own rate."""
    regressor = dynamics.regressor
    if missing := [name for name in regressor.joints if name not in body.joint_names]:
        raise HabitusError(
            f"{body.name} has no joint {missing[0]!r}, which drives its dynamics; load it with "
            "all joints"
        )
    joints = [body.joint_names.index(name) for name in regressor.joints]
    return motion_controls(
        regressor.controls, joints, body.parents, body.rest_joints(betas), pose, trans, rate
    )


def dynamics_of(body: BodyModel) -> Dynamics:
    """What the body knows of soft tissue in motion. Raises HabitusError where that is nothing."""
    if body.dynamics is None:
        raise HabitusError(
            f"{body.name} has no dynamic blend shapes; take a body that has some, or learn them: "
            "habitus train-dynamics"
        )
    return body.dynamics


def _check(
    body: BodyModel, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray, rate: float
) -> None:
    shapes = {"betas": (betas.shape, (min(betas.size, body.num_betas),))}
    shapes |= {
        "pose": (pose.shape, (len(pose), body.num_joints, 3)),
        "trans": (trans.shape, (len(pose), 3)),
    }
    for name, (found, expected) in shapes.items():
        if found != expected:
            raise HabitusError(
                f"{name} has shape {found}; expected {expected} for {body.name}: frames of one "
                "person"
            )
    if not (np.isfinite(pose).all() and np.isfinite(trans).all() and np.isfinite(betas).all()):
        raise HabitusError("the motion holds numbers that are not finite; fill its gaps first")
    if not SLOWEST_HZ <= rate <= 1e5:
        raise HabitusError(
            f"the rate is {rate:g} Hz; expected {SLOWEST_HZ:g} or more frames a second"
        )
