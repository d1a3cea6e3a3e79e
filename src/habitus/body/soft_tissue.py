"""Soft tissue of a body in motion: predicted from how it moves (DMPL: S 6), made stronger or weaker
(M 9.1), and what it may move along: directions of shape (M 6), dynamic blend shapes (S 6) or both.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.arrays import kind_of, to_numpy
from habitus.body.dynamics import Dynamics, at_frames, free_run, motion_controls, resampled
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
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
    coefficients = free_run(
        history, np.clip(controls, -regressor.limits, regressor.limits) @ drive.T
    )
    if len(coefficients) != len(poses) or rate != regressor.rate_hz:
        coefficients = at_frames(coefficients, np.arange(len(poses)) * (regressor.rate_hz / rate))
    return kind.array(strength * coefficients)


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
    for name, (shape, expected) in shapes.items():
        if shape != expected:
            raise HabitusError(
                f"{name} has shape {shape}; expected {expected} for {body.name}: frames of one "
                "person"
            )
    if not (np.isfinite(pose).all() and np.isfinite(trans).all() and np.isfinite(betas).all()):
        raise HabitusError("the motion holds numbers that are not finite; fill its gaps first")
    if not SLOWEST_HZ <= rate <= 1e5:
        raise HabitusError(
            f"the rate is {rate:g} Hz; expected {SLOWEST_HZ:g} or more frames a second"
        )


USUAL = 2.0
"""M 9.1: up to here motion stays natural; 4 gives "interesting effects and, other times, unnatural
body shapes".
"""


def exaggerated(motion: BodyMotion, factor: float) -> BodyMotion:
    """The motion with its soft tissue ``factor`` times as far from its own mean, and pose and place
    as they are.

    M 9.1 multiplies the coefficients of soft tissue; about their mean, so that it is the motion
    that grows and not what a fit's shape stage left over. 1 changes nothing, 0 leaves a body of one
    shape. Coefficients of dynamic blend shapes are scaled likewise. Raises HabitusError for a
    factor below 0 and a motion without soft tissue.
    """
    if not 0 <= factor < np.inf:
        raise HabitusError(
            f"factor {factor:g}; expected 0 (none), 1 (as it is), 1.5 or 2 (exaggerated), …"
        )
    if motion.soft_tissue is None and motion.dynamics is None:
        raise HabitusError(
            f"{motion.capture_name}: holds no soft tissue to exaggerate; fit with it (leave out "
            "--soft-tissue none)"
        )
    note = f"soft tissue {factor:g} times as far from its mean as it was fitted (exaggerated)"
    return replace(
        motion,
        soft_tissue=_scaled(motion.soft_tissue, factor),
        dynamics=_scaled(motion.dynamics, factor),
        made=(*motion.made, note),
    )


def skin_motion(motion: BodyMotion) -> float:
    """How far soft tissue moves the skin from where it is on average (m): root mean square over
    vertices and frames.

    At rest, so that poses have no part in it.
    """
    square = np.zeros(motion.body.num_vertices)
    for directions, coefficients in _spaces(motion):
        covariance = np.cov(coefficients, rowvar=False, bias=True).reshape(directions.shape[-1], -1)
        square += np.einsum("vcb,bd,vcd->v", directions, covariance, directions, optimize=True)
    return float(np.sqrt(square.mean()))


def _spaces(motion: BodyMotion) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What moves the skin (V, 3, S), and how much in every frame (T, S)."""
    if motion.soft_tissue is not None:
        yield motion.body.shapedirs, motion.soft_tissue
    if motion.dynamics is not None:
        yield dynamics_of(motion.body).directions, motion.dynamics


def _away(coefficients: Float[np.ndarray, "T S"]) -> Float[np.ndarray, "T S"]:
    return coefficients - coefficients.mean(axis=0)


def _scaled(
    coefficients: Float[np.ndarray, "T S"] | None, factor: float
) -> Float[np.ndarray, "T S"] | None:
    return None if coefficients is None else coefficients + (factor - 1.0) * _away(coefficients)


SPACES = {"shape": ("shape",), "dynamics": ("dynamics",), "both": ("shape", "dynamics")}
"""Soft-tissue spaces, and the directions that they are made of, in their order."""


def check_space(body: BodyModel, space: str) -> None:
    """Raise HabitusError for a space that is not known, and for one that the body has not."""
    if space not in SPACES:
        raise HabitusError(f"soft tissue is {space!r}; expected one of {', '.join(SPACES)}")
    if "dynamics" in SPACES[space]:
        dynamics_of(body)


def soft_count(body: BodyModel, space: str) -> int:
    """How many coefficients soft tissue has."""
    return sum(
        {"shape": body.num_betas, "dynamics": body.num_dynamics}[part] for part in SPACES[space]
    )


def soft_directions(
    body: BodyModel, space: str, vertices: np.ndarray
) -> tuple[Float[np.ndarray, "N 3 S"], Float[np.ndarray, "J 3 S"]]:
    """How some vertices at rest and the rest joints move with soft tissue; dynamics move no
    joint.
    """
    parts = []
    for part in SPACES[space]:
        if part == "shape":
            parts.append((body.shapedirs[vertices], body.joint_shapedirs))
        else:
            parts.append(
                (
                    dynamics_of(body).directions[vertices],
                    np.zeros((body.num_joints, 3, body.num_dynamics)),
                )
            )
    corners, joints = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    return np.ascontiguousarray(corners), np.ascontiguousarray(joints)


def parted(
    body: BodyModel, space: str, soft_tissue: Float[np.ndarray, "T S"]
) -> tuple[Float[np.ndarray, "T B"], Float[np.ndarray, "T D"] | None]:
    """Coefficients of soft tissue as changes of the betas, zero where the space has none, and as
    dynamics.
    """
    parts = SPACES[space]
    count = body.num_betas if "shape" in parts else 0
    change = soft_tissue[:, :count] if count else np.zeros((len(soft_tissue), body.num_betas))
    return change, soft_tissue[:, count:] if "dynamics" in parts else None
