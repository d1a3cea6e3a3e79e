"""Exact derivatives of vertices and joints with respect to shape, pose and place, for LBS and DQBS alike.

Turning joint j by a small vector m (in the world) turns everything that hangs on it about p_j, and the columns of ``M_j
= R_parent(j) J_l(theta_j)`` are those m for the three entries of theta_j (J_l: left Jacobian). Hence, with u_ik the
part of vertex i that joint k carries, LBS gives ``dv_i / dtheta_j = -[Y_ij]x M_j``, ``Y_ij = sum_{k below j} (u_ik -
w_ik p_j)``. In DQBS the turn multiplies the dual quaternions of all joints below j from the left: what is blended
changes linearly, and only the normalisation does not. Pose blend shapes add their own derivative, turned by the vertex'
blended rotation. Nothing is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from habitus.arrays import broadcast_shapes
from habitus.body.blend_shapes import add_blend_shapes
from habitus.body.kinematics import descends, skinning_motions, world_motions
from habitus.body.model import BodyModel, PreparedBody, Vertices
from habitus.body.pose_features import extended
from habitus.body.skinning import move_points, signed_weights
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


@dataclass(frozen=True)
class SurfaceJacobian:
    """A surface (m) and how it moves: m per unit of betas, m per rad of pose; with ``trans`` it moves one to one."""

    surface: BodySurface
    vertices_betas: Float[Tensor, "*batch N 3 B"]
    vertices_pose: Float[Tensor, "*batch N 3 J 3"]
    joints_betas: Float[Tensor, "*batch J 3 B"]
    joints_pose: Float[Tensor, "*batch K 3 J 3"]


@dataclass(frozen=True)
class _Skeleton:
    """A posed skeleton and its derivatives: place, joints' own motions, and what moves them."""

    rotations: Float[Tensor, "*batch J 3 3"]
    world: Float[Tensor, "*batch J 3 4"]
    motions: Float[Tensor, "*batch J 3 4"]
    below: Float[Tensor, "J J"]  # [j, k]: 1 where k is j or hangs on it
    turns: Float[Tensor, "*batch J 3 3"]  # columns of M_j
    local_turns: Float[Tensor, "*batch J 3 3"]  # columns of J_l(theta_j)
    joints_betas: Float[Tensor, "*batch J 3 B"]
    shifts_betas: Float[Tensor, "*batch J 3 B"]  # derivative of the motions' last column


def surface_jacobian(
    body: BodyModel,
    betas: Float[Tensor, "*#batch B"],
    pose: Float[Tensor, "*#batch J 3"],
    trans: Float[Tensor, "*#batch 3"] | None = None,
    *,
    vertices: Vertices | None = None,
) -> SurfaceJacobian:
    """The surface of S 3, eq. 11, and its exact derivatives with respect to betas and pose (rotation vectors, rad).

    Meant for a subset of vertices: memory is ``3 N (3 J + B)`` numbers for each of the batch.
    """
    batch = broadcast_shapes(betas.shape[:-1], pose.shape[:-2])
    prepared = body.prepare(betas, vertices)
    rest_joints, pose = (x.expand(*batch, body.num_joints, 3) for x in (prepared.rest_joints, pose))
    skeleton = _skeleton(body, rest_joints, pose)
    rest, by_betas = prepared.shaped, prepared.rows.shapedirs.unflatten(-1, (3, -1)).permute(2, 1, 0)
    if prepared.rows.posedirs is not None:
        feature = body.features.of_pose(pose, skeleton.rotations)
        rest = add_blend_shapes(rest, extended(feature, prepared.betas, body.shape_features), prepared.rows.posedirs)
        if body.shape_features:
            by_betas = by_betas + _offsets_by_betas(prepared, feature)
    rest = rest.unflatten(-1, (3, -1)).mT.expand(*batch, -1, 3)
    move = _linear if body.skinning == "lbs" else _dual
    moved, turn, by_turns, by_shifts = move(prepared, skeleton, rest)
    by_pose = by_turns
    if prepared.rows.posedirs is not None:
        by_pose = by_pose + torch.einsum("...ncd,...ndjm->...ncjm", turn, _offsets_by_pose(prepared, skeleton, pose))
    joints = skeleton.world[..., 3]
    arms = skeleton.below.T[..., None] * (joints[..., :, None, :] - joints[..., None, :, :])
    by_joints = (-cross_matrix(arms) @ skeleton.turns[..., None, :, :, :]).movedim(-3, -2)
    place = 0 if trans is None else trans[..., None, :]
    surface = BodySurface(moved + place, joints + place)
    return SurfaceJacobian(surface, turn @ by_betas + by_shifts, by_pose, skeleton.joints_betas, by_joints)


def _skeleton(
    body: BodyModel, rest_joints: Float[Tensor, "*batch J 3"], pose: Float[Tensor, "*batch J 3"]
) -> _Skeleton:
    rotations = matrix_from_rotvec(pose)
    world = world_motions(rotations, rest_joints, body.parents)
    parents = torch.tensor(body.parents[1:], dtype=torch.int64, device=pose.device)
    above = torch.cat([torch.eye(3).to(world).expand_as(world[..., :1, :, :3]), world[..., parents, :, :3]], -3)
    local_turns = left_jacobian(pose)
    below = descends(body.parents, pose.dtype, pose.device)
    by_betas = body.joint_shapedirs
    steps = torch.cat([by_betas[:1], by_betas[1:] - by_betas[parents]])
    joints_betas = torch.einsum("jk,...jcb->...kcb", below, above @ steps)
    shifts_betas = joints_betas - world[..., :3] @ by_betas
    motions = skinning_motions(world, rest_joints)
    return _Skeleton(rotations, world, motions, below, above @ local_turns, local_turns, joints_betas, shifts_betas)


def _blocks(prepared: PreparedBody) -> Float[Tensor, "S P 3 N"]:
    """Pose blend shapes in 1 + s blocks of (J - 1) k: for all shapes alike, then times each shape coefficient."""
    assert prepared.rows.posedirs is not None
    return prepared.rows.posedirs.unflatten(0, (1 + prepared.model.shape_features, -1)).unflatten(-1, (3, -1))


def _offsets_by_betas(prepared: PreparedBody, feature: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch N 3 B"]:
    """Derivative of the pose blend shapes' offsets by all shape coefficients: zero after the first s."""
    offsets = torch.einsum("sfcn,...f->...ncs", _blocks(prepared)[1:], feature)
    return torch.nn.functional.pad(offsets, (0, prepared.model.num_betas - prepared.model.shape_features))


def _offsets_by_pose(
    prepared: PreparedBody, skeleton: _Skeleton, pose: Float[Tensor, "*batch J 3"]
) -> Float[Tensor, "*batch N 3 J 3"]:
    """Derivative of the pose blend shapes' offsets: the features' slope times J_l, no root."""
    features = prepared.model.features
    change = features.slope(pose[..., 1:, :]) @ skeleton.local_turns[..., 1:, :, :]
    first, *others = _blocks(prepared).unflatten(1, (-1, features.per_joint))
    for beta, block in zip(prepared.betas.unbind(-1), others, strict=True):
        first = first + beta[..., None, None, None, None] * block
    offsets = torch.einsum("...jfcn,...jfm->...ncjm", first, change)
    return torch.nn.functional.pad(offsets, (0, 0, 1, 0))


_Moved = tuple[
    Tensor, Tensor, Tensor, Tensor
]  # vertices, blended rotations, derivative by pose (rigid part), by shifts


def _linear(prepared: PreparedBody, skeleton: _Skeleton, rest: Float[Tensor, "*batch N 3"]) -> _Moved:
    index, value = prepared.rows.influences.index, prepared.rows.influences.value
    motions = skeleton.motions[..., index, :, :] * value[..., None, None]
    parts = (motions[..., :3] @ rest[..., None, :, None]).squeeze(-1) + motions[..., 3]
    below = skeleton.below[:, index]
    lever = torch.einsum("jnk,...nkc->...njc", below, parts)
    share = torch.einsum("jnk,nk->nj", below, value)
    lever = lever - share[..., None] * skeleton.world[..., None, :, :, 3]
    by_turns = (-cross_matrix(lever) @ skeleton.turns[..., None, :, :, :]).movedim(-3, -2)
    by_shifts = torch.einsum("nk,...nkcb->...ncb", value, skeleton.shifts_betas[..., index, :, :])
    return parts.sum(-2), motions[..., :3].sum(-3), by_turns, by_shifts


def _dual(prepared: PreparedBody, skeleton: _Skeleton, rest: Float[Tensor, "*batch N 3"]) -> _Moved:
    single = dual_quaternion_from_rigid(skeleton.motions[..., :3], skeleton.motions[..., 3])
    weights = signed_weights(single[..., :4], prepared.rows.influences)
    blended = weights @ single
    moved = move_points(blended.mT, rest.mT).mT
    real, dual = blended.split(4, -1)
    by_real, by_dual = _point_by_dual_quaternion(real, dual, rest, moved)
    parts = weights[..., None] * single[..., None, :, :]
    carried = (skeleton.below @ parts)[..., None, :]
    turns = skeleton.turns.mT[..., None, :, :, :]
    slides = torch.linalg.cross(skeleton.world[..., None, :, None, :, 3].expand_as(turns), turns)
    real_by_turns = quaternion_multiply(pure_quaternion(turns), carried[..., :4]) / 2
    dual_by_turns = quaternion_multiply(pure_quaternion(turns), carried[..., 4:]) / 2
    dual_by_turns = dual_by_turns + quaternion_multiply(pure_quaternion(slides), carried[..., :4]) / 2
    by_turns = torch.einsum("...ncq,...njmq->...ncjm", by_real, real_by_turns)
    by_turns = by_turns + torch.einsum("...ncq,...njmq->...ncjm", by_dual, dual_by_turns)
    shifts = quaternion_multiply(pure_quaternion(skeleton.shifts_betas.mT), single[..., None, :4]) / 2
    dual_by_shifts = torch.einsum("...nk,...kbq->...nqb", weights, shifts)
    return moved, matrix_from_quaternion(real), by_turns, by_dual @ dual_by_shifts


def _point_by_dual_quaternion(
    real: Float[Tensor, "*batch N 4"],
    dual: Float[Tensor, "*batch N 4"],
    points: Float[Tensor, "*batch N 3"],
    moved: Float[Tensor, "*batch N 3"],
) -> tuple[Float[Tensor, "*batch N 3 4"], Float[Tensor, "*batch N 3 4"]]:
    """Derivatives of ``v = vec(q x q* + 2 e q*) / |q|^2`` with respect to the real part q and the dual part e."""
    conjugate = quaternion_conjugate(real)
    units = torch.eye(4, dtype=real.dtype, device=real.device)
    by_left = _columns(lambda unit, factor: quaternion_multiply(unit, factor), units)
    by_conjugate = _columns(lambda unit, factor: quaternion_multiply(factor, quaternion_conjugate(unit)), units)
    factor = 2 / (real * real).sum(-1)[..., None, None]
    by_real = by_left(quaternion_multiply(pure_quaternion(points), conjugate)) + by_conjugate(dual)
    by_real = by_real - moved[..., None] * real[..., None, :]
    return factor * by_real, factor * by_left(conjugate)


def _columns(product: Callable[[Tensor, Tensor], Tensor], units: Float[Tensor, "4 4"]) -> Callable[[Tensor], Tensor]:
    """The vector part of a product with each unit quaternion, as the columns of a matrix (*batch, 3, 4)."""
    return lambda factor: product(units, factor[..., None, :])[..., 1:].mT
