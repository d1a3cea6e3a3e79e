"""Legs that reach a place: the knee bends by what the distance asks, the hip turns, the foot keeps
its heading.

In closed form for all frames at once. A leg that is where it should be stays as it is.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.motion import BodyMotion
from habitus.body.skinning import world_motions
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

SOFT_KNEE = float(np.deg2rad(8.0))
"""Default bend of a knee (rad) up to which it gives way to smoothness."""


class Skeleton(NamedTuple):
    """A motion's joints: local rotations, rest places (soft tissue moves them), motions in the
    world (T, J, 3, 4).
    """

    rotations: Float[np.ndarray, "T J 3 3"]
    rest: Float[np.ndarray, "T J 3"]
    world: Float[np.ndarray, "T J 3 4"]


class Leg(NamedTuple):
    """The numbers of a leg's joints."""

    above: int
    hip: int
    knee: int
    ankle: int


def skeleton_of(motion: BodyMotion) -> Skeleton:
    """The skeleton of a motion in every frame, ``trans`` included."""
    body = motion.body
    shape = motion.betas if motion.soft_tissue is None else motion.betas + motion.soft_tissue
    rest = body.joint_template + np.einsum("jcb,...b->...jc", body.joint_shapedirs, shape)
    rest = np.broadcast_to(rest, (motion.num_frames, body.num_joints, 3))
    rotations = matrix_from_rotvec(motion.pose)
    world = world_motions(rotations, rest, body.parents)
    world[..., 3] += motion.trans[:, None]
    return Skeleton(rotations, rest, world)


def legs_of(body) -> tuple[Leg, Leg]:
    """Left and right leg of a body that has SMPL's joints there."""
    find = {name: k for k, name in enumerate(body.joint_names)}
    return tuple(  # type: ignore[return-value]
        Leg(
            body.parents[find[f"{side}_hip"]],
            *(find[f"{side}_{part}"] for part in ("hip", "knee", "ankle")),
        )
        for side in ("left", "right")
    )


def bones(
    skeleton: Skeleton, leg: Leg
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Thigh and shank at rest, from joint to joint."""
    rest = skeleton.rest
    return rest[:, leg.knee] - rest[:, leg.hip], rest[:, leg.ankle] - rest[:, leg.knee]


def reach(
    pose: Float[np.ndarray, "T J 3"],
    skeleton: Skeleton,
    leg: Leg,
    goal: Float[np.ndarray, "T 3"],
    soft: float = SOFT_KNEE,
) -> Float[np.ndarray, "T J 3"]:
    """The pose with a leg whose ankle is at ``goal`` (m, world), as near as the leg is long, the
    foot turned as before.

    The knee bends further about the thigh's x axis, on the side on which it is bent.
    """
    world = skeleton.world
    thigh_shank = bones(skeleton, leg)
    thigh = thigh_shank[0]
    knee = skeleton.rotations[:, leg.knee]
    way = goal - world[:, leg.hip, :, 3]
    knee = _bent(thigh, knee, thigh_shank[1], np.linalg.norm(way, axis=1), soft) @ knee
    hip = world[:, leg.hip, :, :3]
    now = (hip @ (thigh[..., None] + knee @ thigh_shank[1][..., None]))[..., 0]
    hip = _onto(now, way) @ hip
    shank = hip @ knee
    out = pose.copy()
    for joint, rotation in (
        (leg.hip, np.swapaxes(world[:, leg.above, :, :3], 1, 2) @ hip),
        (leg.knee, knee),
        (leg.ankle, np.swapaxes(shank, 1, 2) @ world[:, leg.ankle, :, :3]),
    ):
        moved = np.abs(rotation - skeleton.rotations[:, joint]).max(axis=(1, 2)) > 1e-12
        out[moved, joint] = rotvec_from_matrix(rotation[moved])
    return out


def _bent(
    thigh: np.ndarray, knee: np.ndarray, shank: np.ndarray, distance: np.ndarray, soft: float
) -> Float[np.ndarray, "T 3 3"]:
    """Rotation about x that brings hip and ankle to nearly ``distance``: |a + R u|² = d², with u
    the bent shank.

    The unknown is the square of the bend from straight: see `_root`.
    """
    a = thigh
    u = (knee @ shank[..., None])[..., 0]
    cosine = a[:, 1] * u[:, 1] + a[:, 2] * u[:, 2]
    sine = a[:, 2] * u[:, 1] - a[:, 1] * u[:, 2]
    projection = 0.5 * (distance**2 - (a**2).sum(1) - (u**2).sum(1)) - a[:, 0] * u[:, 0]
    straight = np.arctan2(sine, cosine)
    size = np.maximum(np.hypot(sine, cosine), 1e-12)
    square = np.arccos(np.clip(projection / size, -1.0, 1.0)) ** 2
    now = -straight * np.abs(straight)
    angle = _root(now + square - straight**2, soft) - _root(now, soft)
    return matrix_from_rotvec(np.column_stack([angle, np.zeros((len(angle), 2))]))


def _root(square: Float[np.ndarray, " T"], soft: float) -> Float[np.ndarray, " T"]:
    """The bend (rad) by its signed square, from 0 to ``soft`` less steep than a root.

    A leg that is nearly straight gets shorter by next to nothing however it bends: a millimetre
    asks for 5 degrees. It is not worth a knee that jumps.
    """
    return square / np.sqrt(np.abs(square) + soft**2)


def _onto(bone: np.ndarray, other: np.ndarray) -> Float[np.ndarray, "T 3 3"]:
    """The smallest rotations that take the directions of ``bone`` to those of ``other``."""
    a, b = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12) for v in (bone, other))
    axis = np.cross(a, b)
    cosine = (a * b).sum(1)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, cosine)
    return matrix_from_rotvec(axis * (angle / np.maximum(sine, 1e-12))[:, None])
