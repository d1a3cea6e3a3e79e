"""A fit as a skinned animation: fixed bind pose, joint rotations and translations, a few morphs.

File formats and GPU viewers know linear skinning with a fixed bind pose and morph targets. A fit has more: soft
tissue moves the shape, and with it the joints, in every frame, and pose blend shapes move it too. Both are linear
in known coefficients, so they are folded, exactly, into (a) morph targets and (b) small joint translations.

Skinning with joints J(t) = J + d(t), x' = A_j (x - J_j(t)) + P_j(t), equals skinning with the fixed J when each
joint's node moves to P_j(t) - A_j d_j(t); relative to its parent that is  offset_j + (I - L_j) d_j(t)  with the
local rotation L_j.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.export.arrays import BodyArrays, body_arrays, up_rotation


@dataclass(frozen=True)
class Animation:
    """Skinned animation in a +y-up world, metres. Quaternions are (x, y, z, w), local, without sign jumps.

    ``morph_weights`` are for the full deformation; ``pose_morph_weights`` and ``joint_translations_rigid`` leave
    soft tissue out. ``morph_residual`` is the RMS (metres, over vertices and frames) of what the kept morphs cannot
    express.
    """

    body: BodyArrays
    rest_vertices: Float[np.ndarray, "V 3"]
    rest_joints: Float[np.ndarray, "J 3"]
    quaternions: Float[np.ndarray, "T J 4"]
    joint_translations: Float[np.ndarray, "T J 3"]
    joint_translations_rigid: Float[np.ndarray, "T J 3"]
    morphs: Float[np.ndarray, "K V 3"]
    morph_weights: Float[np.ndarray, "T K"]
    pose_morph_weights: Float[np.ndarray, "T K"]
    morph_residual: float
    rate_hz: float
    joints_move: bool


def animate(fit: Any, max_morphs: int = 64, tolerance: float = 2e-5, stride: int = 1) -> Animation:
    """The skinned animation of a ``MarkerFit``, every ``stride``-th frame.

    Keeps the fewest morphs whose RMS residual is below ``tolerance`` (metres), at most ``max_morphs``.
    """
    body, betas = body_arrays(fit.body), np.asarray(fit.betas, np.float64)
    pose, trans = np.asarray(fit.pose, np.float64)[::stride], np.asarray(fit.trans, np.float64)[::stride]
    soft = None if fit.soft_tissue is None else np.asarray(fit.soft_tissue, np.float64)[::stride]
    joints = body.joints + body.joint_shapedirs @ betas
    quaternions = local_quaternions(pose)
    rotations = Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix().reshape(*pose.shape[:2], 3, 3)
    morphs, pose_weights, weights, residual = _deformation(body, rotations, soft, max_morphs, tolerance)
    world = up_rotation(fit.up_axis)
    rigid = _joint_translations(body, joints, rotations, trans, None)
    moving = rigid if soft is None else _joint_translations(body, joints, rotations, trans, soft)
    return Animation(
        body=body,
        rest_vertices=body.template + body.shapedirs @ betas,
        rest_joints=joints,
        quaternions=_turn_root(quaternions, world),
        joint_translations=_turn_root_translation(moving, world),
        joint_translations_rigid=_turn_root_translation(rigid, world),
        morphs=morphs,
        morph_weights=weights,
        pose_morph_weights=pose_weights,
        morph_residual=residual,
        rate_hz=float(fit.rate_hz) / stride,
        joints_move=soft is not None,
    )


def local_quaternions(pose: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T J 4"]:
    """Rotation vectors to quaternions (x, y, z, w)."""
    return Rotation.from_rotvec(pose.reshape(-1, 3)).as_quat().reshape(*pose.shape[:2], 4)


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """Flip signs so that neighbours in time lie on the same half of the sphere: linear interpolation is then safe."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=-1) < 0
    sign = np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    return np.concatenate([quaternions[:1], quaternions[1:] * sign[..., None]])


def _turn_root(quaternions: np.ndarray, world: np.ndarray) -> np.ndarray:
    turned = quaternions.copy()
    turned[:, 0] = (Rotation.from_matrix(world) * Rotation.from_quat(quaternions[:, 0])).as_quat()
    return _continuous(turned)


def _turn_root_translation(translations: np.ndarray, world: np.ndarray) -> np.ndarray:
    turned = translations.copy()
    turned[:, 0] = translations[:, 0] @ world.T
    return turned


def _joint_translations(
    body: BodyArrays, joints: np.ndarray, rotations: np.ndarray, trans: np.ndarray, soft: np.ndarray | None
) -> np.ndarray:
    """Joint translations relative to the parent (T, J, 3); the module's text has the formula."""
    offsets = joints - np.where(np.array(body.parents)[:, None] < 0, 0.0, joints[np.maximum(body.parents, 0)])
    result = np.broadcast_to(offsets, (len(trans), *offsets.shape)).copy()
    if soft is not None:
        moved = np.einsum("jcb,tb->tjc", body.joint_shapedirs, soft)
        result += moved - np.einsum("tjcd,tjd->tjc", rotations, moved)
    result[:, 0] += trans
    return result


def _deformation(
    body: BodyArrays, rotations: np.ndarray, soft: np.ndarray | None, max_morphs: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Principal morphs of the rest-space deformation: (K,V,3), weights (rigid, full) (T,K), RMS.

    The deformation is D = B C^T with blend shapes B (3V, n) and coefficients C (T, n). With B = Q R the principal
    directions of D are Q u, u the leading eigenvectors of R (C^T C) R^T: no (3V, T) matrix is ever built.
    """
    frames, vertices = len(rotations), len(body.template)
    shapes, pose_coefficients, coefficients = _blend_terms(body, rotations, soft)
    if not shapes.shape[1] or not max_morphs:
        none = np.zeros((frames, 0))
        return np.zeros((0, vertices, 3)), none, none, 0.0
    basis, upper = np.linalg.qr(shapes)
    values, directions = np.linalg.eigh(upper @ (coefficients.T @ coefficients) @ upper.T)
    values, directions = np.maximum(values[::-1], 0.0), directions[:, ::-1]
    left_over = np.sqrt(np.append(np.cumsum(values[::-1])[::-1], 0.0) / (frames * vertices))
    kept = int(min(max_morphs, np.argmax(left_over <= max(tolerance, 1e-9)), len(values)))
    project = upper.T @ directions[:, :kept]
    weights, pose_weights = coefficients @ project, pose_coefficients @ project
    scale = np.maximum(np.abs(weights).max(axis=0, initial=0.0), 1e-12)
    morphs = ((basis @ directions[:, :kept]) * scale).T.reshape(kept, vertices, 3)
    return morphs, pose_weights / scale, weights / scale, float(left_over[kept])


def _blend_terms(
    body: BodyArrays, rotations: np.ndarray, soft: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blend shapes (3V, n) and their coefficients (T, n) without and with soft tissue."""
    frames, vertices = len(rotations), len(body.template)
    shapes, rigid, full = [np.zeros((3 * vertices, 0))], [np.zeros((frames, 0))], [np.zeros((frames, 0))]
    if body.posedirs is not None:
        features = (rotations[:, 1:] - np.eye(3)).reshape(frames, -1)
        shapes.append(body.posedirs.reshape(3 * vertices, -1))
        rigid.append(features)
        full.append(features)
    if soft is not None:
        shapes.append(body.shapedirs.reshape(3 * vertices, -1))
        rigid.append(np.zeros_like(soft))
        full.append(soft)
    return np.hstack(shapes), np.hstack(rigid), np.hstack(full)
