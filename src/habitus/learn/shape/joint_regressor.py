"""Joints from surfaces: for each joint a combination of vertices, sparse and convex (S 4.1 "Joint
regressor", Fig. 7).

Convex combinations follow joints that lie between vertices which move as the joint does. Deep in
the trunk none do, and weights below zero are needed: there a convex row may be corrected by small
weights of either sign.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls

from habitus.errors import HabitusError
from habitus.learn.energy import FLIP
from habitus.learn.options import REGRESSORS, SETTINGS, TrainSettings

SUM_WEIGHT = 1.0
"""Metres: of the sum-to-one term. The rows are the same with any; see `fit_joint_regressor`."""


def fit_joint_regressor(
    templates: Float[np.ndarray, "S V 3"],
    joints: Float[np.ndarray, "S J 3"],
    *,
    signs: str = "convex",
    nearness: float = 0.03,
    candidates: Bool[np.ndarray, "J V"] | None = None,
    mirror: Int[np.ndarray, " V"] | None = None,
    joint_mirror: Int[np.ndarray, " J"] | None = None,
    settings: TrainSettings = SETTINGS,
) -> Float[np.ndarray, "J V"]:
    """The regressor J that takes the rest surfaces of S subjects to their joints (metres; S 4.1, T
    5.4.1).

    With ``signs`` "convex" each row w minimises, by non-negative least squares (Lawson and Hanson,
    "Solving least squares problems", 1974),

        sum over subjects |w (T_i - J_i)|^2 + nearness^2 (w d)^2 + SUM_WEIGHT^2 (sum w - 1)^2

    and is then scaled to sum to 1. T_i - J_i are the vertices seen from the joint: the sum of the
    row scales the data term as a whole, so any ``SUM_WEIGHT`` gives the same rows, and where the
    origin lies does not matter. d are the vertices' mean distances from the joint: of combinations
    that explain few subjects equally well, the nearest is taken; it weighs as much as 0.0009 of a
    subject. Only a joint's ``candidates`` get weight (all vertices where None).

    With "signed" such a row is corrected by v that minimises ``sum |(w + v) (T_i - J_i)|^2 +
    ridge^2 |v d|^2``, sum v = 0; the ridge is that of ``settings.regressor_ridges`` with the least
    error on people left out, one fold at a time. With "auto" it is done where that helps
    (``settings.regressor_gain``). Corrections are not sparse. Fewer than three people give convex
    rows.

    Where both ``mirror`` (partners across x = 0) and ``joint_mirror`` are given, subjects count
    also mirrored, and the regressor is symmetric. A row has about as many weights as there are
    numbers to explain, at most three a subject (six, with mirrors), however many candidates there
    are. Raises HabitusError where shapes do not fit or a joint has no candidate.
    """
    _check(templates, joints, candidates, signs)
    people = len(joints)
    j = joints.shape[1]
    v = templates.shape[1]
    allowed = np.ones((j, v), bool) if candidates is None else candidates
    if mirror is None or joint_mirror is None:
        mirror = None
        partner = np.arange(j)
    else:
        partner = joint_mirror
        allowed = allowed | allowed[partner][:, mirror]
        templates = np.concatenate([templates, templates[:, mirror] * FLIP])
        joints = np.concatenate([joints, joints[:, partner] * FLIP])
    regressor = np.zeros((j, v))
    for k in np.flatnonzero(partner >= np.arange(j)):
        chosen = np.flatnonzero(allowed[k])
        offsets = templates[:, chosen] - joints[:, None, k]
        row = _row(offsets, nearness)
        if signs != "convex" and people >= settings.regressor_min_people:
            row = row + _correction(
                offsets,
                row,
                _ridge(offsets, people, nearness, settings, signs == "auto"),
            )
        regressor[k, chosen] = row
        if mirror is not None:
            if partner[k] == k:
                regressor[k] = (regressor[k] + regressor[k, mirror]) / 2
            regressor[partner[k]] = regressor[k, mirror]
    return regressor


def _row(offsets: Float[np.ndarray, "S C 3"], nearness: float) -> Float[np.ndarray, " C"]:
    """The convex combination of vertices, seen from a joint, that lies nearest to it in all
    subjects.
    """
    distance = np.linalg.norm(offsets, axis=2).mean(0)
    data = offsets.transpose(0, 2, 1).reshape(-1, len(distance))
    if len(data) > len(distance):
        data = np.linalg.qr(data, mode="r")
    system = np.concatenate(
        [data, nearness * distance[None], np.full((1, len(distance)), SUM_WEIGHT)]
    )
    row, _ = nnls(system, np.append(np.zeros(len(system) - 1), SUM_WEIGHT))
    return row / row.sum()


def _ridge(
    offsets: Float[np.ndarray, "S C 3"],
    people: int,
    nearness: float,
    settings: TrainSettings,
    only_if_better: bool,
) -> float:
    """The ridge of least error on people left out; with ``only_if_better`` infinite where that
    error is not the settings' share of that of convex rows or less.

    The rows of ``offsets`` are people, then perhaps the same people mirrored.
    """
    person = np.arange(len(offsets)) % people
    fold = person % min(settings.regressor_folds, people)
    ridges = settings.regressor_ridges
    gain = settings.regressor_gain if only_if_better else np.inf
    errors = np.zeros(1 + len(ridges))
    for k in range(fold.max() + 1):
        kept = offsets[fold != k]
        left_out = offsets[fold == k]
        row = _row(kept, nearness)
        rows = [row, *(row + values for values in _corrections(kept, row, ridges))]
        errors += [(np.tensordot(values, left_out, (0, 1)) ** 2).sum() for values in rows]
    best = int(errors[1:].argmin())
    return ridges[best] if errors[1 + best] <= gain**2 * errors[0] else np.inf


def _correction(
    offsets: Float[np.ndarray, "S C 3"], row: Float[np.ndarray, " C"], ridge: float
) -> np.ndarray:
    return np.zeros_like(row) if np.isinf(ridge) else _corrections(offsets, row, (ridge,))[0]


def _corrections(
    offsets: Float[np.ndarray, "S C 3"], row: Float[np.ndarray, " C"], ridges: Sequence[float]
) -> list[Float[np.ndarray, " C"]]:
    """For each ridge the weights that sum to 0 and correct a row: as few equations as people have
    numbers.
    """
    scale = 1 / np.maximum(np.linalg.norm(offsets, axis=2).mean(0), 1e-6)
    system = offsets.transpose(0, 2, 1).reshape(-1, len(row)) * scale
    along = scale / np.linalg.norm(scale)
    system = system - np.outer(system @ along, along)
    values, vectors = np.linalg.eigh(system @ system.T)
    pull = vectors.T @ np.tensordot(offsets, row, (1, 0)).ravel()
    corrections = [
        -system.T @ (vectors @ (pull / (np.maximum(values, 0.0) + ridge**2))) for ridge in ridges
    ]
    return [scale * (values - along * (along @ values)) for values in corrections]


def _check(
    templates: Float[np.ndarray, "..."],
    joints: Float[np.ndarray, "..."],
    candidates: Bool[np.ndarray, "..."] | None,
    signs: str,
) -> None:
    if signs not in REGRESSORS:
        raise HabitusError(
            f"signs of the regressor are {signs!r}; expected one of {', '.join(REGRESSORS)}"
        )
    if templates.ndim != 3 or joints.ndim != 3 or len(templates) != len(joints) or len(joints) == 0:
        raise HabitusError(
            f"templates {templates.shape} and joints {joints.shape}; expected (S, V, 3) and (S, "
            "J, 3) of S subjects"
        )
    if not (np.isfinite(templates).all() and np.isfinite(joints).all()):
        raise HabitusError(
            "templates or joints are not finite; expected numbers in metres: leave such subjects "
            "out"
        )
    if candidates is not None:
        if candidates.shape != (joints.shape[1], templates.shape[1]):
            raise HabitusError(
                f"candidates {candidates.shape}; expected {(joints.shape[1], templates.shape[1])}"
            )
        bare = np.flatnonzero(~candidates.any(1))
        if len(bare):
            raise HabitusError(
                f"joint {bare[0]} has no candidate vertices; expected some: give it weights or all"
            )
