"""A fit as a skinned animation: fixed bind pose, joint rotations and translations, a few morphs.

File formats and GPU viewers know linear skinning with a fixed bind pose and morph targets. A fit
has more: soft tissue moves the shape, and with it the joints, in every frame, and pose blend shapes
move it too. Both are linear in known coefficients, so they are folded, exactly, into (a) morph
targets and (b) small joint translations.

Skinning with joints J(t) = J + d(t), x' = A_j (x - J_j(t)) + P_j(t), equals skinning with the fixed
J when each joint's node moves to P_j(t) - A_j d_j(t); relative to its parent that is
offset_j + (I - L_j) d_j(t) with the local rotation L_j.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel
from habitus.body.pose_features import check_driven_by_rotations
from habitus.body.soft_tissue import dynamics_of
from habitus.errors import HabitusError
from habitus.export.correctives import (
    Block,
    Drivers,
    Morphs,
    check_correctives,
    features,
    morphs_of,
    principal,
    sampled_rotations,
)
from habitus.export.folds import folds, softened
from habitus.export.skeleton import Skeleton, plain_skeleton
from habitus.parallel.blocks import every_nth_frame
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving


STAGES = ("pose", "soft_tissue")
MOST_FRAMES = 100_000
"""Frames of an animation, at most: each takes 20 kB of memory here, and readers hold every key."""
ENTRIES = tuple(f"{row}{column}" for row in "xyz" for column in "xyz")
"""The entries of a joint's R - I, by row and column, in the order of the pose blend shapes."""


@dataclass(frozen=True)
class Track:
    """A motion: local quaternions (x, y, z, w) without sign jumps and translations (m) of the
    skeleton's bones, J of them, and weights of the morphs.
    """

    quaternions: Float[np.ndarray, "T J 4"]
    joint_translations: Float[np.ndarray, "T J 3"]
    morph_weights: Float[np.ndarray, "T K"]


@dataclass(frozen=True)
class Animation:
    """Skinned animation in a +y-up world, metres; one track a stage, all over the same bind pose
    and morphs. The skeleton has a bone a joint until `habitus.export.rigging.rigged` gives others.

    ``morph_names`` say what they hold. ``morph_drivers`` give the weights in any pose of those that
    the joint drives that the name begins with. ``morph_residual`` is the RMS (metres, over vertices
    and frames) of what the kept morphs cannot express, ``morph_worst`` the largest distance, in the
    frames that it can be largest in, ``morph_elsewhere`` that of other poses, where joints drive
    morphs.
    """

    body: BodyModel
    rest_vertices: Float[np.ndarray, "V 3"]
    rest_joints: Float[np.ndarray, "J 3"]
    morphs: Float[np.ndarray, "K V 3"]
    tracks: tuple[Track, ...]
    morph_residual: float
    rate_hz: float
    skeleton: Skeleton
    morph_names: tuple[str, ...] = ()
    morph_drivers: Drivers = field(default_factory=lambda: Drivers.linear(np.zeros((0, 9))))
    morph_worst: float = 0.0
    morph_elsewhere: float = 0.0


@dataclass(frozen=True)
class _Motion:
    """What a stage found, every stride-th frame."""

    rotations: Float[np.ndarray, "T J 3 3"]
    quaternions: Float[np.ndarray, "T J 4"]
    trans: Float[np.ndarray, "T 3"]
    soft: Float[np.ndarray, "T B"] | None
    dynamics: Float[np.ndarray, "T D"] | None


def body_at(fit: "Moving", detail: str) -> BodyModel:
    """The body that files show: "full", its full level of detail where it has one, "parts", that
    with teeth, tongue and lashes where it has such, or "coarse", the fitted one.
    """
    if detail not in ("full", "parts", "coarse"):
        raise HabitusError(f"detail is {detail!r}; expected full, parts or coarse")
    if detail == "parts":
        return fit.finest_body.full or fit.finest_body
    return fit.finest_body if detail == "full" else fit.body


def animate(
    fit: "Moving",
    stages: Sequence[str] | None = None,
    *,
    max_morphs: int = 64,
    tolerance: float = 5e-6,
    stride: int = 1,
    body: BodyModel | None = None,
    correctives: str | None = None,
) -> Animation:
    """The skinned animation of a ``MarkerFit``, every ``stride``-th frame, for some of STAGES
    (default: its last one).

    Keeps the fewest morphs whose RMS residual is below ``tolerance`` (metres), at most
    ``max_morphs``; with ``correctives`` those that `habitus.export.correctives.morphs_of` gives.
    ``body`` is shown in the place of the fitted one: its full level of detail. Raises HabitusError
    where pose blend shapes are not linear in vec(R - I) alone, hinges apart, and for more than
    `MOST_FRAMES` frames.
    """
    check_driven_by_rotations(fit.body, "animations", hinges=True)
    _check_length(fit, stride)
    body = body or fit.body
    betas = np.asarray(fit.betas, np.float64)
    chosen = stages or (STAGES[fit.soft_tissue is not None],)
    motions = [_motion(fit, stage, stride) for stage in chosen]
    joints = body.joint_template + body.joint_shapedirs @ betas
    morphs = _morphs(body, betas, motions, correctives, max_morphs, tolerance)
    world = up_rotation(fit.up_axis)
    tracks = (
        Track(
            continuous_quaternions(turned_root(m.quaternions, world)),
            _joint_translations(body, joints, m, world),
            w,
        )
        for m, w in zip(motions, morphs.weights, strict=True)
    )
    rest = body.v_template + body.shapedirs @ betas
    rate = float(fit.rate_hz) / stride
    shown = body, rest, joints, morphs.shapes, tuple(tracks), morphs.residual, rate
    bones = plain_skeleton(body, joints)
    return Animation(*shown, bones, morphs.names, morphs.drivers, morphs.worst, morphs.elsewhere)


def _check_length(fit: "Moving", stride: int) -> None:
    frames = -(-len(fit.pose) // stride)
    if frames > MOST_FRAMES:
        fps = float(f"{fit.rate_hz * MOST_FRAMES / len(fit.pose):.2g}")
        raise HabitusError(
            f"{fit.capture_name}: {frames:,} frames are too many for one animation; expected at "
            f"most {MOST_FRAMES:,}: choose a lower rate (--fps {0.9 * fps:.2g}), .bvh or .npz"
        )


def _morphs(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    motions: list[_Motion],
    correctives: str | None,
    max_morphs: int,
    tolerance: float,
) -> Morphs:
    sample = (
        sampled_rotations(body)
        if correctives and check_correctives(correctives)[0] == "live"
        else None
    )
    blocks = _blocks(body, betas, motions, sample)
    vertices = len(body.v_template)
    if correctives is None and blocks and max_morphs:
        return principal(blocks, vertices, max_morphs, tolerance)
    return morphs_of(blocks, vertices, [len(m.trans) for m in motions], correctives or "none")


def _motion(fit: "Moving", stage: str, stride: int) -> _Motion:
    last = stage == STAGES[1] or fit.soft_tissue is None
    pose, trans = (fit.pose, fit.trans) if last else fit.pose_stage
    soft, moving = (
        None if array is None or not last else every_nth_frame(array, stride)
        for array in (fit.soft_tissue, fit.dynamics)
    )
    pose, trans = (
        every_nth_frame(np.asarray(array, np.float64), stride) for array in (pose, trans)
    )
    quaternions = local_quaternions(pose)
    rotations = (
        Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix().reshape(*pose.shape[:2], 3, 3)
    )
    return _Motion(rotations, quaternions, trans, soft, moving)


def local_quaternions(pose: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T J 4"]:
    """Rotation vectors to quaternions (x, y, z, w)."""
    return Rotation.from_rotvec(pose.reshape(-1, 3)).as_quat().reshape(*pose.shape[:2], 4)


def continuous_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Flip signs so that neighbours in time lie on the same half of the sphere: linear
    interpolation is then safe.
    """
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=-1) < 0
    sign = np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    return np.concatenate([quaternions[:1], quaternions[1:] * sign[..., None]])


def turned_root(quaternions: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Local quaternions (T, J, 4) in a world turned by a rotation (3, 3)."""
    turned = quaternions.copy()
    turned[:, 0] = (Rotation.from_matrix(world) * Rotation.from_quat(quaternions[:, 0])).as_quat()
    return turned


def _joint_translations(
    body: BodyModel, joints: np.ndarray, motion: _Motion, world: np.ndarray
) -> np.ndarray:
    """Joint translations relative to the parent (T, J, 3); the module's text has the formula."""
    offsets = joints - np.where(
        np.array(body.parents)[:, None] < 0, 0.0, joints[np.maximum(body.parents, 0)]
    )
    result = np.broadcast_to(offsets, (len(motion.trans), *offsets.shape)).copy()
    if motion.soft is not None:
        moved = np.einsum("jcb,tb->tjc", body.joint_shapedirs, motion.soft)
        result += moved - np.einsum("tjcd,tjd->tjc", motion.rotations, moved)
    result[:, 0] = (result[:, 0] + motion.trans) @ world.T
    return result


def _blocks(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    motions: list[_Motion],
    sample: Float[np.ndarray, "S J 3 3"] | None,
) -> list[Block]:
    """The body's blend shapes: those that a joint drives, of the vertices that they move; soft
    tissue; dynamics.
    """
    rotations = [motion.rotations for motion in motions]
    blocks = _linear(body, rotations, sample) + folds(body, betas, rotations, sample)
    everyone = np.arange(len(body.v_template))
    if any(motion.soft is not None for motion in motions):
        soft = _or_still(motions, "soft", body.num_betas)
        shapes, weights = softened(body, rotations, soft)
        blocks.append(Block("soft_tissue", everyone, shapes, weights))
    if any(motion.dynamics is not None for motion in motions):
        directions = dynamics_of(body).directions
        blocks.append(
            Block(
                "dynamics", everyone, directions, _or_still(motions, "dynamics", body.num_dynamics)
            )
        )
    return blocks


def _linear(
    body: BodyModel,
    rotations: list[Float[np.ndarray, "_ J 3 3"]],
    sample: Float[np.ndarray, "S J 3 3"] | None,
) -> list[Block]:
    """The pose blend shapes that are linear in vec(R - I), a block each driving joint."""
    if body.posedirs is None:
        return []
    blocks = []
    for k, joint in enumerate(body.drivers):
        shapes = body.posedirs[..., 9 * k : 9 * k + 9]
        if body.hinges is not None and joint in body.hinges.joint:
            shapes = body.hinges.without_linear(shapes, [joint])
        moved = np.flatnonzero(np.any(shapes, axis=(1, 2)))
        terms = tuple(features(each, joint) for each in rotations)
        usual = None if sample is None else features(sample, joint)
        driven = Drivers.linear(np.eye(9))
        name = body.joint_names[joint]
        blocks.append(Block(name, moved, shapes[moved], terms, ENTRIES, driven, usual))
    return blocks


def _or_still(motions: list[_Motion], name: str, count: int) -> tuple[np.ndarray, ...]:
    arrays = (getattr(motion, name) for motion in motions)
    return tuple(
        np.zeros((len(m.trans), count)) if values is None else np.asarray(values, np.float64)
        for m, values in zip(motions, arrays, strict=True)
    )


def one_sided(animation: Animation) -> Animation:
    """The same animation of its first track with morph weights between 0 and 1: "knee_01" and
    "knee_01_back".

    Some readers, Blender's among them, cut other weights off. A morph with weights of both signs
    becomes two, forth and back; linear interpolation between frames stays the same. Those that
    joints drive keep their size, and each side that any rotation reaches; a fold has one.
    """
    track = animation.tracks[0]
    driven = animation.morph_drivers
    sides = []
    weights = []
    names = []
    drivers = []
    for k, name in enumerate(animation.morph_names):
        for sign, end in ((1.0, ""), (-1.0, "_back"))[: 1 if driven.folds[k] else 2]:
            side = np.maximum(sign * track.morph_weights[:, k], 0.0)
            one = replace(driven[[k]], rows=sign * driven.rows[[k]])
            reach = float(one.reached()[0]) if one.live[0] else side.max()
            if reach > 1e-6:
                sides.append((k, sign * reach))
                weights.append((side / reach).astype(np.float32))
                names.append(f"{name}{end}")
                drivers.append(one)
    frames = len(track.quaternions)
    morphs = np.empty((len(sides), *animation.morphs.shape[1:]), np.float32)
    for n, (k, factor) in enumerate(sides):
        morphs[n] = np.float32(factor) * animation.morphs[k]
    return replace(
        animation,
        morphs=morphs,
        tracks=(replace(track, morph_weights=np.reshape(weights, (-1, frames)).T),),
        morph_names=tuple(names),
        morph_drivers=Drivers.together([driven[:0], *drivers]),
    )
