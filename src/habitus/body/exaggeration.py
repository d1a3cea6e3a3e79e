"""Soft tissue in motion made stronger or weaker (M 9.1)."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.motion import BodyMotion
from habitus.body.soft_tissue import dynamics_of
from habitus.errors import HabitusError

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
            "--no-soft-tissue)"
        )
    said = f"soft tissue {factor:g} times as far from its mean as it was found (exaggerated)"
    return replace(
        motion,
        soft_tissue=_scaled(motion.soft_tissue, factor),
        dynamics=_scaled(motion.dynamics, factor),
        made=(*motion.made, said),
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
