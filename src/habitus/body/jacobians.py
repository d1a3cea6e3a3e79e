"""Exact derivatives of vertices and joints with respect to shape, pose and place, for LBS and DQBS
alike.

Turning joint j by a small vector m (in the world) turns everything that hangs on it about p_j, and
the columns of ``M_j = R_parent(j) J_l(theta_j)`` are those m for the three entries of theta_j (J_l:
left Jacobian). Hence, with u_ik the part of vertex i that joint k carries, LBS gives ``dv_i /
dtheta_j = -[Y_ij]x M_j``, ``Y_ij = sum_{k below j} (u_ik - w_ik p_j)``. In DQBS the turn multiplies
the dual quaternions of all joints below j from the left: what is blended changes linearly, and only
the normalisation does not. Pose blend shapes add their own derivative, turned by the vertex'
blended rotation. Nothing is left out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.arrays import (
    add_slices,
    broadcast_shapes,
    cast,
    constant,
    cross,
    eye,
    flatten,
    kind_of,
    namespace,
    unbind,
    unflatten,
)
from habitus.body.body_arrays import add_blend_shapes
from habitus.body.model import BodyModel
from habitus.body.pose_features import ENTRIES, Hinges, pose_coefficients
from habitus.body.prepared import PreparedBody
from habitus.body.skinning import (
    descends,
    move_points,
    signed_weights,
    skinning_motions,
    world_motions,
)
from habitus.body.state import BodySurface
from habitus.rotations import (
    cross_matrix,
    dual_quaternion_from_rigid,
    left_jacobian,
    matrix_from_quaternion,
    matrix_from_rotvec,
    pure_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
)
from habitus.types import Array, ArrayLike


@dataclass(frozen=True)
class SurfaceJacobian:
    """A surface (m) and how it moves: m per unit of betas, m per rad of pose; with ``trans`` it
    moves one to one.

    ``vertices_dynamics`` is there where dynamics were given: m per unit of their coefficients,
    which move no joint.
    """

    surface: BodySurface
    vertices_betas: Float[Array, "*batch N 3 B"]
    vertices_pose: Float[Array, "*batch N 3 J 3"]
    joints_betas: Float[Array, "*batch J 3 B"]
    joints_pose: Float[Array, "*batch K 3 J 3"]
    vertices_dynamics: Float[Array, "*batch N 3 D"] | None = None


@dataclass(frozen=True)
class PosedSkeleton:
    """A posed skeleton and its derivatives: place, joints' own motions, and what moves them."""

    rotations: Float[Array, "*batch J 3 3"]
    world: Float[Array, "*batch J 3 4"]
    motions: Float[Array, "*batch J 3 4"]
    below: Float[Array, "J J"]  # [j, k]: 1 where k is j or hangs on it
    turns: Float[Array, "*batch J 3 3"]  # columns of M_j
    local_turns: Float[Array, "*batch J 3 3"]  # columns of J_l(theta_j)
    joints_betas: Float[Array, "*batch J 3 B"]
    shifts_betas: Float[Array, "*batch J 3 B"]  # derivative of the motions' last column


def surface_jacobian(
    body: BodyModel,
    betas: ArrayLike = (),
    pose: ArrayLike | Mapping[str, ArrayLike] | None = None,
    trans: ArrayLike | None = None,
    *,
    vertices: ArrayLike | None = None,
    dynamics: ArrayLike | None = None,
) -> SurfaceJacobian:
    """The surface of S 3, eq. 11, and its exact derivatives with respect to betas and pose
    (rotation vectors, rad).

    Takes what the body takes, and answers in the same kind. Meant for a subset of vertices: memory
    is ``3 N (3 J + B)`` numbers for each of the batch.
    """
    kind = kind_of(
        betas, *(pose.values() if isinstance(pose, Mapping) else (pose,)), trans, dynamics
    )
    moving = None if dynamics is None else kind.array(dynamics)
    prepared = body.prepare(kind.array(betas), vertices, dynamics=moving)
    angles: Array = body.full_pose(pose, kind)
    batch = broadcast_shapes(prepared.betas.shape[:-1], angles.shape[:-2])
    rest_joints, angles = (
        kind.xp.broadcast_to(x, (*batch, body.num_joints, 3))
        for x in (prepared.rest_joints, angles)
    )
    skeleton = posed_skeleton(body, rest_joints, angles)
    rest = prepared.shaped
    directions = unflatten(prepared.rows.shapedirs.T, 0, (3, -1)).swapaxes(0, 1)
    by_betas = directions[..., : body.num_betas]
    if prepared.rows.posedirs is not None:
        driven = (body.features, body.hinges, body.shape_features, body.drivers)
        moved = pose_coefficients(*driven, angles, skeleton.rotations, prepared.betas)
        rest = add_blend_shapes(rest, moved, prepared.rows.posedirs)
        if body.shape_features:
            feature = body.features.of_pose(angles, skeleton.rotations, body.drivers)
            by_betas = by_betas + _offsets_by_betas(prepared, feature)
        if body.hinges is not None:
            first = len(body.drivers) * ENTRIES
            folds = moved[..., first : first + body.hinges.count]
            weights = folds[..., :: 1 + body.hinges.num_shapes]
            by_betas = by_betas + _folds_by_betas(prepared, body.hinges, weights)
    rest = unflatten(rest, -1, (3, -1)).mT
    rest = kind.xp.broadcast_to(rest, (*batch, *rest.shape[-2:]))
    move = _linear if body.skinning == "lbs" else _dual
    moved, turn, by_pose, by_shifts = move(prepared, skeleton, rest)
    if prepared.rows.posedirs is not None:
        offsets = flatten(_offsets_by_pose(prepared, skeleton, angles), -2)
        offsets = unflatten(turn @ offsets, -1, (-1, 3))
        by_pose = add_slices(by_pose, body.drivers, offsets, -2)
    joints = skeleton.world[..., 3]
    arms = skeleton.below.T[..., None] * (joints[..., :, None, :] - joints[..., None, :, :])
    by_joints = kind.xp.moveaxis(-cross_matrix(arms) @ skeleton.turns[..., None, :, :, :], -3, -2)
    place = 0 if trans is None else kind.array(trans)[..., None, :]
    surface = BodySurface(moved + place, joints + place, kind.index(body.faces), prepared.betas)
    by_dynamics = (
        None if moving is None else turn @ directions[..., body.num_betas + body.num_expressions :]
    )
    return SurfaceJacobian(
        surface, turn @ by_betas + by_shifts, by_pose, skeleton.joints_betas, by_joints, by_dynamics
    )


def posed_skeleton(
    body: BodyModel, rest_joints: Float[Array, "*batch J 3"], pose: Float[Array, "*batch J 3"]
) -> PosedSkeleton:
    """The skeleton of a body with these joints at rest (m) in this pose (rad), at the origin."""
    xp = namespace(pose)
    parents = list(body.parents[1:])
    rotations = matrix_from_rotvec(pose)
    world = world_motions(rotations, rest_joints, body.parents)
    root = xp.broadcast_to(eye(3, world), (*world.shape[:-3], 1, 3, 3))
    above = xp.concatenate([root, world[..., parents, :, :3]], -3)
    local_turns = left_jacobian(pose)
    below = constant(descends(body.parents), pose)
    by_betas = constant(body.joint_shapedirs, pose)
    steps = xp.concatenate([by_betas[:1], by_betas[1:] - by_betas[parents]])
    joints_betas = unflatten(below.T @ flatten(above @ steps, -2), -1, (3, -1))
    shifts_betas = joints_betas - world[..., :3] @ by_betas
    motions = skinning_motions(world, rest_joints)
    return PosedSkeleton(
        rotations,
        world,
        motions,
        below,
        above @ local_turns,
        local_turns,
        joints_betas,
        shifts_betas,
    )


def _blocks(prepared: PreparedBody) -> Float[Array, "S P 3 N"]:
    """Pose blend shapes in 1 + s blocks of (J - 1) k: for all shapes alike, then times each shape
    coefficient.
    """
    assert prepared.rows.posedirs is not None
    model = prepared.model
    plain = prepared.rows.posedirs[
        : model.features.count(1 + len(model.drivers), model.shape_features)
    ]
    return unflatten(unflatten(plain, 0, (1 + model.shape_features, -1)), -1, (3, -1))


def _folds(prepared: PreparedBody, hinges: Hinges) -> Float[Array, "C S1 3 N"]:
    """Directions of the hinges: for all shapes alike, then times each of S shape coefficients."""
    assert prepared.rows.posedirs is not None
    first = len(prepared.model.drivers) * ENTRIES
    rows = prepared.rows.posedirs[first : first + hinges.count]
    return unflatten(unflatten(rows, 0, (-1, 1 + hinges.num_shapes)), -1, (3, -1))


def _folds_by_betas(
    prepared: PreparedBody, hinges: Hinges, weights: Float[Array, "*batch C"]
) -> Float[Array, "*batch N 3 B"]:
    """Derivative of the hinges' offsets by all shape coefficients: zero after the first S."""
    xp = namespace(weights)
    directions = _folds(prepared, hinges)[:, 1:]  # (C, S, 3, N)
    offsets = xp.tensordot(weights, directions, 1).swapaxes(-1, -3)
    others = prepared.model.num_betas - hinges.num_shapes
    return xp.concatenate([offsets, constant(np.zeros((*offsets.shape[:-1], others)), weights)], -1)


def _folds_by_pose(
    prepared: PreparedBody,
    hinges: Hinges,
    feature: Float[Array, "*batch F"],
    change: Float[Array, "*batch P 9 3"],
) -> Float[Array, "*batch N 3 P 3"]:
    """Derivative of the hinges' offsets by the driving joints' rotations, ``change`` that of their
    features.
    """
    drivers = prepared.model.drivers
    driven = hinges.driven(feature, drivers)
    slope = 2 * driven * cast(driven < 1, driven)
    factors = constant(np.ones(1), feature)
    if hinges.num_shapes:
        shape = prepared.betas[..., : hinges.num_shapes]
        xp = namespace(feature, shape)
        factors = xp.concatenate([xp.ones_like(shape[..., :1]), shape], -1)
    directions = (_folds(prepared, hinges) * factors[..., None, :, None, None]).sum(-3)
    rows = unflatten(constant(hinges.rows_of(drivers, hinges.rows), feature), -1, (-1, 9))
    pulls = (slope[..., None, None] * rows)[..., None, :] @ change[..., None, :, :, :]
    by_channel = flatten(pulls[..., 0, :], -2)  # (*batch, C, 3 P)
    offsets = flatten(directions.swapaxes(-1, -2), -2).swapaxes(-1, -2) @ by_channel
    return unflatten(unflatten(offsets, -1, (-1, 3)), -3, (-1, 3))


def _offsets_by_betas(
    prepared: PreparedBody, feature: Float[Array, "*batch P"]
) -> Float[Array, "*batch N 3 B"]:
    """Derivative of the pose blend shapes' offsets by all shape coefficients: zero after the first
    s.
    """
    xp = namespace(feature)
    blocks = _blocks(prepared)[1:]
    rows = flatten(xp.moveaxis(blocks, 1, 0), 1)  # (P, s 3 N)
    offsets = unflatten(feature @ rows, -1, (blocks.shape[0], 3, blocks.shape[-1])).swapaxes(-1, -3)
    others = prepared.model.num_betas - prepared.model.shape_features
    return xp.concatenate([offsets, constant(np.zeros((*offsets.shape[:-1], others)), feature)], -1)


def _offsets_by_pose(
    prepared: PreparedBody, skeleton: PosedSkeleton, pose: Float[Array, "*batch J 3"]
) -> Float[Array, "*batch N 3 P 3"]:
    """Derivative of the pose blend shapes' offsets by the joints that drive: slope times J_l."""
    xp = namespace(pose)
    features = prepared.model.features
    drivers = prepared.model.drivers
    change = features.slope(pose[..., drivers, :]) @ skeleton.local_turns[..., drivers, :, :]
    first, *others = unbind(unflatten(_blocks(prepared), 1, (-1, features.per_joint)), 0)
    for beta, block in zip(unbind(prepared.betas)[: len(others)], others, strict=True):
        first = first + beta[..., None, None, None, None] * block
    offsets = flatten(first, -2).mT @ change  # (*batch, P, 3 N, 3)
    offsets = xp.moveaxis(unflatten(offsets, -2, (3, -1)), -2, -4).swapaxes(-2, -3)
    if (hinges := prepared.model.hinges) is not None:
        feature = features.of_pose(pose, skeleton.rotations, drivers)
        offsets = offsets + _folds_by_pose(prepared, hinges, feature, change)
    return offsets


_Moved = tuple[
    Array, Array, Array, Array
]  # vertices, blended rotations, derivative by pose (rigid part), by shifts


def _linear(
    prepared: PreparedBody, skeleton: PosedSkeleton, rest: Float[Array, "*batch N 3"]
) -> _Moved:
    index = prepared.rows.influences.index
    value = prepared.rows.influences.value
    motions = skeleton.motions[..., index, :, :] * value[..., None, None]
    parts = (motions[..., :3] @ rest[..., None, :, None])[..., 0] + motions[..., 3]
    below = skeleton.below[:, index].swapaxes(0, 1)  # (N, J, K)
    share = (below @ value[..., None])[..., 0]
    lever = below @ parts - share[..., None] * skeleton.world[..., None, :, :, 3]
    # a cross product with each column of a rotation, as one product of matrices a joint
    units = -cross_matrix(eye(3, lever)) @ skeleton.turns[..., None, :, :]
    by_turns = unflatten(lever.swapaxes(-3, -2) @ flatten(units, -2), -1, (3, 3))
    shifts = prepared.rows.influences.dense.T @ flatten(skeleton.shifts_betas, -2)
    return (
        parts.sum(-2),
        motions[..., :3].sum(-3),
        namespace(by_turns).moveaxis(by_turns, -4, -2),
        unflatten(shifts, -1, (3, -1)),
    )


def _dual(
    prepared: PreparedBody, skeleton: PosedSkeleton, rest: Float[Array, "*batch N 3"]
) -> _Moved:
    single = dual_quaternion_from_rigid(skeleton.motions[..., :3], skeleton.motions[..., 3])
    weights = signed_weights(single[..., :4], prepared.rows.influences)
    blended = weights @ single
    moved = move_points(blended.mT, rest.mT).mT
    real = blended[..., :4]
    dual = blended[..., 4:]
    by_real, by_dual = _point_by_dual_quaternion(real, dual, rest, moved)
    parts = weights[..., None] * single[..., None, :, :]
    carried = (skeleton.below @ parts)[..., None, :]
    turns = skeleton.turns.mT[..., None, :, :, :]
    slides = cross(skeleton.world[..., None, :, None, :, 3], turns)
    real_by_turns = quaternion_multiply(pure_quaternion(turns), carried[..., :4]) / 2
    dual_by_turns = quaternion_multiply(pure_quaternion(turns), carried[..., 4:]) / 2
    dual_by_turns = (
        dual_by_turns + quaternion_multiply(pure_quaternion(slides), carried[..., :4]) / 2
    )
    by_turns = (
        by_real @ flatten(real_by_turns, -3, -2).mT + by_dual @ flatten(dual_by_turns, -3, -2).mT
    )
    by_turns = unflatten(by_turns, -1, (-1, 3))
    shifts = (
        quaternion_multiply(pure_quaternion(skeleton.shifts_betas.mT), single[..., None, :4]) / 2
    )
    dual_by_shifts = unflatten(weights @ flatten(shifts, -2), -1, (-1, 4)).mT
    return moved, matrix_from_quaternion(real), by_turns, by_dual @ dual_by_shifts


def _point_by_dual_quaternion(
    real: Float[Array, "*batch N 4"],
    dual: Float[Array, "*batch N 4"],
    points: Float[Array, "*batch N 3"],
    moved: Float[Array, "*batch N 3"],
) -> tuple[Float[Array, "*batch N 3 4"], Float[Array, "*batch N 3 4"]]:
    """Derivatives of ``v = vec(q x q* + 2 e q*) / |q|^2`` with respect to the real part q and the
    dual part e.
    """
    conjugate = quaternion_conjugate(real)
    units = eye(4, real)
    by_left = _columns(lambda unit, factor: quaternion_multiply(unit, factor), units)
    by_conjugate = _columns(
        lambda unit, factor: quaternion_multiply(factor, quaternion_conjugate(unit)), units
    )
    factor = 2 / (real * real).sum(-1)[..., None, None]
    by_real = by_left(quaternion_multiply(pure_quaternion(points), conjugate)) + by_conjugate(dual)
    by_real = by_real - moved[..., None] * real[..., None, :]
    return factor * by_real, factor * by_left(conjugate)


def _columns(
    product: Callable[[Array, Array], Array], units: Float[Array, "4 4"]
) -> Callable[[Array], Array]:
    """The vector part of a product with each unit quaternion, as the columns of a matrix (*batch,
    3, 4).
    """
    return lambda factor: product(units, factor[..., None, :])[..., 1:].mT
