"""A motion put into another one's world, so that the two can be compared place by place."""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.motion import Moving
from habitus.body.up import up_rotation

M = TypeVar("M", bound=Moving)
SAME_WORLD = 0.10
"""Metres: joints that are nearer on average lie in one world."""
_WON = 0.5  # of the distance that turning and moving must leave, or less


@dataclass(frozen=True)
class Placing:
    """x' = rotation x + translation (m); ``told`` says in a sentence why, and is empty where
    nothing was moved.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    told: str = ""

    @property
    def degrees(self) -> float:
        """How far it turns."""
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))

    def apply(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points of the one world in the other."""
        return points @ self.rotation.T + self.translation


def same_up(a: Moving, b: Moving) -> Placing:
    """What turns b's world so that its up is a's."""
    return Placing(up_rotation(a.up_axis).T @ up_rotation(b.up_axis), np.zeros(3))


def rigid(wanted: Float[np.ndarray, "N 3"], points: Float[np.ndarray, "N 3"]) -> Placing:
    """The turn and the way that bring points nearest to where they are wanted (Kabsch 1976)."""
    middles = wanted.mean(0), points.mean(0)
    left, _, right = np.linalg.svd((wanted - middles[0]).T @ (points - middles[1]))
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return Placing(turn, middles[0] - turn @ middles[1])


def placing(a: Moving, b: Moving, joints: tuple[np.ndarray, np.ndarray], align: str) -> Placing:
    """What puts b into a's world: ``joints`` are the shared ones of both, (T, J, 3) each, in their
    own worlds.

    align: "none" turns b so that both have one up; "rigid" brings all joints of all frames nearest;
    "auto" does so where the two plainly have different worlds: SAME_WORLD apart, and less than half
    of that when brought together.
    """
    upright = same_up(a, b)
    if align == "none":
        return upright
    wanted, points = (part.reshape(-1, 3) for part in joints)
    near = rigid(wanted, points)
    before, after = (
        float(np.linalg.norm(p.apply(points) - wanted, axis=1).mean()) for p in (upright, near)
    )
    if align == "auto" and not (before > SAME_WORLD and after < _WON * before):
        return upright
    moved = replace(near, rotation=near.rotation @ upright.rotation.T)
    lead = "B's world is another: " if align == "auto" else ""
    told = (
        f"{lead}joints were {100 * before:.0f} cm apart; B as a whole was turned by "
        f"{moved.degrees:.1f} degrees"
    )
    return replace(near, told=f"{told} and moved to where they are {1e3 * after:.0f} mm apart.")


def moved(moving: M, place: Placing, up_axis: str) -> M:
    """The same motion, with its markers where it has such, in the world that ``place`` leads to."""
    pose, trans = _moved(moving, moving.pose, moving.trans, place, last=True)
    changes: dict[str, Any] = {"pose": pose, "trans": trans, "up_axis": up_axis}
    if hasattr(moving, "observed_markers"):
        changes["pose_stage"] = _moved(moving, *moving.pose_stage, place, last=False)
        for name in ("observed_markers", "predicted_pose_stage", "predicted_soft_tissue"):
            points = getattr(moving, name)
            changes[name] = None if points is None else place.apply(np.asarray(points))
    return replace(moving, **changes)  # type: ignore[type-var]


def _moved(
    moving: Moving, pose: np.ndarray, trans: np.ndarray, place: Placing, last: bool
) -> tuple[Any, Any]:
    turned = np.array(pose, np.float64)
    turned[:, 0] = (
        Rotation.from_matrix(place.rotation) * Rotation.from_rotvec(turned[:, 0])
    ).as_rotvec()
    body = moving.body
    root = body.joint_template[0] + body.joint_shapedirs[0] @ moving.betas
    if last and moving.soft_tissue is not None:
        root = root + np.asarray(moving.soft_tissue) @ body.joint_shapedirs[0].T
    return turned, place.apply(root + trans) - root
