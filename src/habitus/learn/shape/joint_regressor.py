"""Joints from surfaces: for each joint a sparse convex combination of vertices (S 4.1 "Joint regressor", Fig. 7)."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls

from habitus.errors import HabitusError
from habitus.learn.terms import FLIP

SUM_WEIGHT = 1.0
"""Metres: of the sum-to-one term. The rows are the same with any; see `fit_joint_regressor`."""


def fit_joint_regressor(
    templates: Float[np.ndarray, "S V 3"],
    joints: Float[np.ndarray, "S J 3"],
    *,
    nearness: float = 0.03,
    candidates: Bool[np.ndarray, "J V"] | None = None,
    mirror: Int[np.ndarray, " V"] | None = None,
    joint_mirror: Int[np.ndarray, " J"] | None = None,
) -> Float[np.ndarray, "J V"]:
    """The regressor J that takes the rest surfaces of S subjects to their joints (metres; S 4.1, T 5.4.1).

    Each row w minimises, by non-negative least squares (Lawson and Hanson, "Solving least squares problems", 1974),

        sum over subjects |w (T_i - J_i)|^2 + nearness^2 (w d)^2 + SUM_WEIGHT^2 (sum w - 1)^2

    and is then scaled to sum to 1. T_i - J_i are the vertices seen from the joint: the sum of the row scales the data
    term as a whole, so any ``SUM_WEIGHT`` gives the same rows, and where the origin lies does not matter. d are the
    vertices' mean distances from the joint: of combinations that explain few subjects equally well, the nearest is
    taken; it weighs as much as 0.0009 of a subject. Only a joint's ``candidates`` get weight (all vertices where None).

    Where both ``mirror`` (partners across x = 0) and ``joint_mirror`` are given, subjects count also mirrored, and the
    regressor is symmetric. A row has about as many weights as there are numbers to explain, at most three a subject
    (six, with mirrors), however many candidates there are. Raises HabitusError where shapes do not fit or a joint has
    no candidate.
    """
    _check(templates, joints, candidates)
    j, v = joints.shape[1], templates.shape[1]
    allowed = np.ones((j, v), bool) if candidates is None else candidates
    if mirror is None or joint_mirror is None:
        mirror, partner = None, np.arange(j)
    else:
        partner = joint_mirror
        allowed = allowed | allowed[partner][:, mirror]
        templates = np.concatenate([templates, templates[:, mirror] * FLIP])
        joints = np.concatenate([joints, joints[:, partner] * FLIP])
    regressor = np.zeros((j, v))
    for k in np.flatnonzero(partner >= np.arange(j)):
        near = np.flatnonzero(allowed[k])
        regressor[k, near] = _row(templates[:, near] - joints[:, None, k], nearness)
        if mirror is not None:
            if partner[k] == k:
                regressor[k] = (regressor[k] + regressor[k, mirror]) / 2
            regressor[partner[k]] = regressor[k, mirror]
    return regressor


def _row(away: Float[np.ndarray, "S C 3"], nearness: float) -> Float[np.ndarray, " C"]:
    """The convex combination of vertices, seen from a joint, that lies nearest to it in all subjects."""
    distance = np.linalg.norm(away, axis=2).mean(0)
    data = away.transpose(0, 2, 1).reshape(-1, len(distance))
    if len(data) > len(distance):
        data = np.linalg.qr(data, mode="r")
    system = np.concatenate([data, nearness * distance[None], np.full((1, len(distance)), SUM_WEIGHT)])
    row, _ = nnls(system, np.append(np.zeros(len(system) - 1), SUM_WEIGHT))
    return row / row.sum()


def _check(
    templates: Float[np.ndarray, "..."], joints: Float[np.ndarray, "..."], candidates: Bool[np.ndarray, "..."] | None
) -> None:
    if templates.ndim != 3 or joints.ndim != 3 or len(templates) != len(joints) or len(joints) == 0:
        raise HabitusError(
            f"templates {templates.shape} and joints {joints.shape}; expected (S, V, 3) and (S, J, 3) of S subjects"
        )
    if not (np.isfinite(templates).all() and np.isfinite(joints).all()):
        raise HabitusError("templates or joints are not finite; expected numbers in metres: leave such subjects out")
    if candidates is not None:
        if candidates.shape != (joints.shape[1], templates.shape[1]):
            raise HabitusError(f"candidates {candidates.shape}; expected {(joints.shape[1], templates.shape[1])}")
        bare = np.flatnonzero(~candidates.any(1))
        if len(bare):
            raise HabitusError(f"joint {bare[0]} has no candidate vertices; expected some: give it weights or all")
