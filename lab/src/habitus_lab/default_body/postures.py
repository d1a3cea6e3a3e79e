"""The postures in which people are measured, linear in the points of MakeHuman's A-pose.

MakeHuman rests with its arms 49 degrees below the horizontal and its feet 36 cm apart; the survey's
people stood with arms down and heels together, or stretched their arms out for the span. Every limb
is turned by one fixed rotation about its own joint (linear blend skinning); joints are linear in
the body's points, so the posed points are too: x' = sum_s w_s (R_s x + t_s), with t_s a linear
function of the joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from .rig import bone_weights
from .sources import Source

# limb -> (stems of its bones, its pivot's joint cube, the limb it hangs on)
LIMBS = {
    "collar": (("clavicle", "shoulder01"), "clavicle", None),
    "upper_arm": (("upperarm",), "shoulder", "collar"),
    "forearm": (("lowerarm",), "elbow", "upper_arm"),
    "hand": (("wrist", "metacarpal", "finger"), "hand", "forearm"),
    "thigh": (("upperleg",), "upper-leg", None),
    "shank": (("lowerleg",), "knee", "thigh"),
    "foot": (("foot", "toe"), "ankle", "shank"),
}
COLLAR = {
    "standing": -4.0,
    "span": 8.0,
}  # degrees the clavicle goes up with the arm: its share of the arm's way
ARM = {
    "standing": (0.12, -1.0, 0.03),
    "span": (1.0, 0.0, 0.0),
}  # direction of upper arm, forearm and hand
HEEL = {
    "standing": 0.052
}  # metres from the midline to the ankle's centre: heels together; other postures leave legs
KNEE = (
    11248,
    11248,
    13002,
    13003,
)  # base vertices over the epicondyles: height targets shift the knee's cube
POSTURES = ("rest", "standing", "span")


@dataclass(frozen=True)
class Posture:
    """A linear map of points: limb -> weights (W,), rotation (3,3), shift's sparse (3, 3W) on flat
    points (left side).

    `flip` mirrors the right side's limbs.
    """

    weights: dict[str, np.ndarray]  # left_/right_ limb -> (W,); "trunk"
    turns: dict[str, np.ndarray]
    shifts: dict[str, sparse.csr_matrix]

    def rows(self, points: sparse.csr_matrix) -> sparse.csr_matrix:
        """(3Q, 3W) map from flat base points to flat posed points, where a point is a row (Q, W)
        over vertices.
        """
        total = sparse.csr_matrix((3 * points.shape[0], 3 * points.shape[1]))
        for limb, weight in self.weights.items():
            moved = (points @ sparse.diags(weight)).tocsr()
            if moved.nnz == 0:
                continue
            total = total + sparse.kron(moved, self.turns[limb])
            if limb in self.shifts:
                total = (
                    total
                    + sparse.kron(sparse.csr_matrix(moved.sum(1)), np.eye(3)) @ self.shifts[limb]
                )
        return total.tocsr()


def posture(name: str, source: Source, reference: np.ndarray) -> Posture:
    """One of POSTURES; rotations are those that bring the reference body's (W,3) limbs to the
    posture's directions.
    """
    weights = _limb_weights(source)
    if name == "rest":
        return Posture({"trunk": np.ones(len(reference))}, {"trunk": np.eye(3)}, {})
    pivots = {limb: _pivot(source, cube, len(reference)) for limb, (_, cube, _) in LIMBS.items()}
    place = {limb: row @ reference.ravel() for limb, row in pivots.items()}
    left_turns = _turns(name, place, _cube(source, "l-finger-3-1") @ reference)
    turns = {"trunk": np.eye(3)}
    shifts = {}
    flip = np.diag([-1.0, 1.0, 1.0])
    for side in ("left", "right"):
        sign = np.eye(3) if side == "left" else flip
        for limb, (_, _, parent) in LIMBS.items():
            turn = sign @ left_turns[limb] @ sign
            pivot = pivots[limb] if side == "left" else _mirrored(pivots[limb], source.mirror)
            key = f"{side}_{limb}"
            here = (
                pivot
                if parent is None
                else _moved(pivot, turns[f"{side}_{parent}"], shifts[f"{side}_{parent}"])
            )
            turns[key] = turn
            shifts[key] = (here - sparse.csr_matrix(turn) @ pivot).tocsr()
    return Posture(weights, turns, shifts)


def _turns(name: str, place: dict[str, np.ndarray], knuckle: np.ndarray) -> dict[str, np.ndarray]:
    """Left limb -> rotation (3,3)."""
    arm = np.array(ARM[name])
    turns = {"collar": _about_z(np.radians(COLLAR[name]))}
    ends = {"upper_arm": "forearm", "forearm": "hand"}
    for limb, end in ends.items():
        turns[limb] = shortest(place[end] - place[limb], arm)
    turns["hand"] = shortest(knuckle.ravel() - place["hand"], arm)
    leg = place["foot"] - place["thigh"]
    aim = leg.copy()
    if name in HEEL:
        aim[0] = HEEL[name] - place["thigh"][0]
    turns["thigh"] = turns["shank"] = shortest(leg, aim)
    turns["foot"] = np.eye(3)
    return turns


def shortest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotation (3,3) that takes direction a to direction b by the shortest way."""
    a = a / np.linalg.norm(a)
    b = b / np.linalg.norm(b)
    x, y, z = np.cross(a, b)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + k + k @ k / (1 + a @ b)


def _about_z(angle: float) -> np.ndarray:
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _limb_weights(source: Source) -> dict[str, np.ndarray]:
    table = {
        f"{side}_{limb}": np.zeros(len(source.vertices))
        for side in ("left", "right")
        for limb in LIMBS
    }
    for bone, value in bone_weights(source).items():
        stem, _, side = bone.partition(".")
        for limb, (stems, _, _) in LIMBS.items():
            if stem.startswith(stems):
                table[{"L": "left_", "R": "right_"}[side] + limb] += value
    table["trunk"] = 1 - sum(table.values())
    return table


def _cube(source: Source, name: str) -> sparse.csr_matrix:
    """(1, W) mean of a joint cube's corners; the knee is midway between its epicondyles, as in the
    rig.
    """
    corners = np.array(KNEE) if name == "l-knee" else source.groups["joint-" + name]
    count = len(corners)
    return sparse.csr_matrix(
        (np.full(count, 1 / count), (np.zeros(count, int), corners)), (1, len(source.vertices))
    )


def _pivot(source: Source, cube: str, count: int) -> sparse.csr_matrix:
    """(3, 3W) map from flat points to the pivot."""
    return sparse.kron(_cube(source, "l-" + cube), np.eye(3)).tocsr()


def _mirrored(pivot: sparse.csr_matrix, mirror: np.ndarray) -> sparse.csr_matrix:
    """The right twin of a left pivot: its mean runs over the twins of the left one's corners."""
    found = pivot.tocoo()
    return sparse.csr_matrix(
        (found.data, (found.row, 3 * mirror[found.col // 3] + found.col % 3)), pivot.shape
    )


def _moved(
    pivot: sparse.csr_matrix, turn: np.ndarray, shift: sparse.csr_matrix
) -> sparse.csr_matrix:
    return (sparse.csr_matrix(turn) @ pivot + shift).tocsr()
