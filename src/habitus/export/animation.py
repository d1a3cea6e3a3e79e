"""A fit as a skinned animation: fixed bind pose, joint rotations and translations, a few morphs.

File formats and GPU viewers know linear skinning with a fixed bind pose and morph targets. A fit has more: soft
tissue moves the shape, and with it the joints, in every frame, and pose blend shapes move it too. Both are linear
in known coefficients, so they are folded, exactly, into (a) morph targets and (b) small joint translations.

Skinning with joints J(t) = J + d(t), x' = A_j (x - J_j(t)) + P_j(t), equals skinning with the fixed J when each
joint's node moves to P_j(t) - A_j d_j(t); relative to its parent that is  offset_j + (I - L_j) d_j(t)  with the
local rotation L_j.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel
from habitus.body.pose_features import check_driven_by_rotations
from habitus.body.soft_tissue import dynamics_of
from habitus.body.up import up_rotation
from habitus.parallel.blocks import thinned

if TYPE_CHECKING:
    from habitus.body.motion import Moving


STAGES = ("pose", "soft_tissue")


@dataclass(frozen=True)
class Track:
    """A motion: local quaternions (x, y, z, w) without sign jumps, joint translations (m), weights of the morphs."""

    quaternions: Float[np.ndarray, "T J 4"]
    joint_translations: Float[np.ndarray, "T J 3"]
    morph_weights: Float[np.ndarray, "T K"]


@dataclass(frozen=True)
class Animation:
    """Skinned animation in a +y-up world, metres; one track a stage, all over the same bind pose and morphs.

    ``morph_residual`` is the RMS (metres, over vertices and frames) of what the kept morphs cannot express.
    """

    body: BodyModel
    rest_vertices: Float[np.ndarray, "V 3"]
    rest_joints: Float[np.ndarray, "J 3"]
    morphs: Float[np.ndarray, "K V 3"]
    tracks: tuple[Track, ...]
    morph_residual: float
    rate_hz: float


@dataclass(frozen=True)
class _Motion:
    """What a stage found, every stride-th frame."""

    rotations: Float[np.ndarray, "T J 3 3"]
    quaternions: Float[np.ndarray, "T J 4"]
    trans: Float[np.ndarray, "T 3"]
    soft: Float[np.ndarray, "T B"] | None
    dynamics: Float[np.ndarray, "T D"] | None


def animate(
    fit: "Moving",
    stages: Sequence[str] | None = None,
    *,
    max_morphs: int = 64,
    tolerance: float = 5e-6,
    stride: int = 1,
    body: BodyModel | None = None,
) -> Animation:
    """The skinned animation of a ``MarkerFit``, every ``stride``-th frame, for some of STAGES (default: its last one).

    Keeps the fewest morphs whose RMS residual is below ``tolerance`` (metres), at most ``max_morphs``. ``body`` is
    shown in the place of the fitted one: its full level of detail. Raises HabitusError where pose blend shapes are not
    linear in vec(R - I) alone.
    """
    check_driven_by_rotations(fit.body, "animations")
    body, betas = body or fit.body, np.asarray(fit.betas, np.float64)
    chosen = stages or (STAGES[fit.soft_tissue is not None],)
    motions = [_motion(fit, stage, stride) for stage in chosen]
    joints = body.joint_template + body.joint_shapedirs @ betas
    morphs, weights, residual = _deformation(body, motions, max_morphs, tolerance)
    world = up_rotation(fit.up_axis)
    tracks = (
        Track(_turn_root(m.quaternions, world), _joint_translations(body, joints, m, world), w)
        for m, w in zip(motions, weights, strict=True)
    )
    rest = body.v_template + body.shapedirs @ betas
    return Animation(body, rest, joints, morphs, tuple(tracks), residual, float(fit.rate_hz) / stride)


def _motion(fit: "Moving", stage: str, stride: int) -> _Motion:
    last = stage == STAGES[1] or fit.soft_tissue is None
    pose, trans = (fit.pose, fit.trans) if last else fit.pose_stage
    soft, moving = (
        None if array is None or not last else thinned(array, stride) for array in (fit.soft_tissue, fit.dynamics)
    )
    pose, trans = (thinned(np.asarray(array, np.float64), stride) for array in (pose, trans))
    quaternions = local_quaternions(pose)
    rotations = Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix().reshape(*pose.shape[:2], 3, 3)
    return _Motion(rotations, quaternions, trans, soft, moving)


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


def _joint_translations(body: BodyModel, joints: np.ndarray, motion: _Motion, world: np.ndarray) -> np.ndarray:
    """Joint translations relative to the parent (T, J, 3); the module's text has the formula."""
    offsets = joints - np.where(np.array(body.parents)[:, None] < 0, 0.0, joints[np.maximum(body.parents, 0)])
    result = np.broadcast_to(offsets, (len(motion.trans), *offsets.shape)).copy()
    if motion.soft is not None:
        moved = np.einsum("jcb,tb->tjc", body.joint_shapedirs, motion.soft)
        result += moved - np.einsum("tjcd,tjd->tjc", motion.rotations, moved)
    result[:, 0] = (result[:, 0] + motion.trans) @ world.T
    return result


def _deformation(
    body: BodyModel, motions: list[_Motion], max_morphs: int, tolerance: float
) -> tuple[np.ndarray, list[np.ndarray], float]:
    """Principal morphs of the rest-space deformation (K, V, 3), their weights (T, K) for each motion, RMS residual.

    The deformation is D = B C^T with blend shapes B (3V, n) and coefficients C (T, n). With B^T B = U U^T (U from its
    eigenvectors) the columns of Q = B U^-T are orthonormal and the principal directions of D are Q v, v the leading
    eigenvectors of U^T (C^T C) U: no (3V, T) matrix is ever built.
    """
    vertices = len(body.v_template)
    shapes, coefficients = _blend_terms(body, motions)
    if not shapes.shape[1] or not max_morphs:
        return np.zeros((0, vertices, 3)), [c[:, :0] for c in coefficients], 0.0
    squares, axes = np.linalg.eigh(shapes.T @ shapes)
    used = squares > 1e-13 * squares[-1]
    root, inverse = axes[:, used] * np.sqrt(squares[used]), axes[:, used] / np.sqrt(squares[used])
    values, directions = np.linalg.eigh(root.T @ sum(c.T @ c for c in coefficients) @ root)
    values, directions = np.maximum(values[::-1], 0.0), directions[:, ::-1]
    samples = vertices * sum(len(c) for c in coefficients)
    left_over = np.sqrt(np.append(np.cumsum(values[::-1])[::-1], 0.0) / samples)
    kept = int(min(max_morphs, np.argmax(left_over <= max(tolerance, 1e-9)), len(values)))
    weights = [c @ (root @ directions[:, :kept]) for c in coefficients]
    scale = np.maximum(np.abs(np.concatenate(weights)).max(axis=0, initial=0.0), 1e-12)
    morphs = (shapes @ (inverse @ directions[:, :kept]) * scale).T.reshape(kept, vertices, 3)
    return morphs, [w / scale for w in weights], float(left_over[kept])


def _blend_terms(body: BodyModel, motions: list[_Motion]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Blend shapes (3V, n) and their coefficients (T, n) for each motion."""
    rows = 3 * len(body.v_template)
    shapes, coefficients = [np.zeros((rows, 0))], [[np.zeros((len(m.trans), 0))] for m in motions]
    if body.posedirs is not None:
        shapes.append(body.posedirs.reshape(rows, -1))
        for terms, motion in zip(coefficients, motions, strict=True):
            terms.append((motion.rotations[:, body.drivers] - np.eye(3)).reshape(len(motion.trans), -1))
    if any(motion.soft is not None for motion in motions):
        shapes.append(body.shapedirs.reshape(rows, -1))
        for terms, motion in zip(coefficients, motions, strict=True):
            still = np.zeros((len(motion.trans), body.shapedirs.shape[-1]))
            terms.append(still if motion.soft is None else np.asarray(motion.soft, np.float64))
    if any(motion.dynamics is not None for motion in motions):
        shapes.append(dynamics_of(body).directions.reshape(rows, -1))
        for terms, motion in zip(coefficients, motions, strict=True):
            still = np.zeros((len(motion.trans), body.num_dynamics))
            terms.append(still if motion.dynamics is None else np.asarray(motion.dynamics, np.float64))
    return np.hstack(shapes), [np.hstack(terms) for terms in coefficients]
