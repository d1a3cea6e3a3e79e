"""Where a fit begins: the root from the trunk's markers by Procrustes, the joints from the best of
a few plain poses.

No T-pose is needed: each frame tries every plain pose, standing, sitting, crouching or with arms
up, from any side.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.gaps import bridge, bridge_rotations
from habitus.fit.markers.recordings import few_markers
from habitus.fit.markers.sequence import fit_sequence, windows
from habitus.fit.markers.settings import (
    START,
    WINDOWS,
    SequenceSettings,
    StartSettings,
    WindowSettings,
)
from habitus.fit.search import best_of_tries
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.parallel.blocks import drop_pages, empty_array
from habitus.rotations import procrustes, rotvec_from_matrix
from habitus.solve.sequence import SequenceOptions

TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar")
# joint: rotation vector (rad) of the left side; the right side mirrors y and z
PLAIN_POSES: tuple[dict[str, tuple[float, float, float]], ...] = (
    {"shoulder": (0.0, 0.0, -1.2), "elbow": (0.0, -0.2, 0.0)},
    {},
    {
        "hip": (-1.5, 0.0, 0.1),
        "knee": (1.5, 0.0, 0.0),
        "shoulder": (0.0, -0.5, -1.0),
        "elbow": (0.0, -0.8, 0.0),
    },
    {
        "hip": (-0.9, 0.0, 0.2),
        "knee": (1.2, 0.0, 0.0),
        "shoulder": (0.0, -1.2, 0.0),
        "elbow": (0.0, -0.5, 0.0),
    },
    {"shoulder": (0.0, -0.3, 1.0), "elbow": (0.0, -0.5, 0.0)},
)


def plain_pose(
    joint_names: tuple[str, ...], angles: dict[str, tuple[float, float, float]]
) -> Float[np.ndarray, "J 3"]:
    """A symmetric pose from the left side's joint angles."""
    pose = np.zeros((len(joint_names), 3))
    for k, name in enumerate(joint_names):
        side, _, part = name.rpartition("_")
        if side in ("left", "right") and part in angles:
            pose[k] = np.array(angles[part]) * (
                1.0 if side == "left" else np.array([1.0, -1.0, -1.0])
            )
    return pose


def start_frames(
    rig: MarkedBody,
    joint_names: tuple[str, ...],
    trunk: Float[np.ndarray, " M"],
    observed: Float[np.ndarray, "F M 3"],
    prior: PosePrior,
    settings: StartSettings = START,
) -> tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F 3"]]:
    """Pose and trans of single frames, each solved by itself from every plain pose; the cheapest is
    kept.

    trunk: (M,) weight of each marker in the alignment of the root (1 on the trunk, small
    elsewhere).
    """
    rough = SequenceOptions(strides=(1,), sweeps=settings.sweeps, tolerance=settings.tolerance)
    tries = []
    for angles in PLAIN_POSES:
        pose = np.repeat(plain_pose(joint_names, angles)[None], len(observed), axis=0)
        pose, trans = align_root(rig, pose, observed, trunk)
        for firmness in settings.pose_weights:
            uncoupled = SequenceSettings(pose=firmness, acceleration=0.0, options=rough)
            result = fit_sequence(rig, observed, None, None, prior, pose, trans, uncoupled)
            pose = result.pose
            trans = result.trans
        tries.append(result)
    costs, poses, places = (
        np.stack([getattr(each, name) for each in tries])
        for name in ("frame_costs", "pose", "trans")
    )
    pose, trans = best_of_tries(costs, poses, places)
    return pose, trans


def start_sequence(
    rig: MarkedBody,
    known_poses: Float[np.ndarray, "N J 3"],
    joint_names: tuple[str, ...],
    observed: Float[np.ndarray, "T M 3"],
    settings: StartSettings = START,
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """A start for every frame: the known or plain pose that fits best every few frames, the root
    aligned in all.

    known_poses: those of the shape stage. Frames with too few markers start on the straight way
    between those with enough. The whole-sequence solve begins with every 16th frame, then goes
    finer.
    """
    enough = ~few_markers(observed)
    bank = _bank(known_poses, joint_names)
    upright = _upright_markers(rig, bank)
    looked_at = _nearest_of(
        np.flatnonzero(enough), np.arange(0, len(observed), settings.frame_step)
    )
    misfit = [_alignment(markers[None], observed[looked_at])[2] for markers in upright]
    nearest = np.repeat(np.argmin(misfit, axis=0), settings.frame_step)[: len(observed)]
    pose, trans = _placed(rig, bank[nearest], *_alignment(upright[nearest], observed)[:2])
    pose[:, 0] = bridge_rotations(pose[:, 0], enough)
    return pose, bridge(trans, enough)


def start_long(
    rig: MarkedBody,
    known_poses: Float[np.ndarray, "N J 3"],
    joint_names: tuple[str, ...],
    observed: Float[np.ndarray, "T M 3"],
    longest: int,
    settings: StartSettings = START,
    cut: WindowSettings = WINDOWS,
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """`start_sequence` of a capture of any length."""
    parts = windows(few_markers(observed), longest, cut)
    if len(parts) == 1:
        return start_sequence(rig, known_poses, joint_names, observed, settings)
    pose = empty_array((len(observed), rig.num_joints, 3))
    trans = empty_array((len(observed), 3))
    for window in parts:
        states = start_sequence(rig, known_poses, joint_names, observed[window.solved], settings)
        pose[window.kept], trans[window.kept] = (each[window.inside] for each in states)
        drop_pages(pose, trans, observed)
    return pose, trans


def start_frame(
    rig: MarkedBody,
    known_poses: Float[np.ndarray, "N J 3"],
    joint_names: tuple[str, ...],
    observed: Float[np.ndarray, "M 3"],
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " 3"]]:
    """`start_sequence` of a single frame: pose and trans; all poses are tried at once, as a stream
    has no time.
    """
    bank = _bank(known_poses, joint_names)
    matrix, shift, misfit = _alignment(_upright_markers(rig, bank), observed[None])
    pose, trans = best_of_tries(misfit, *_placed(rig, bank, matrix, shift))
    return pose, trans


def _bank(known_poses: np.ndarray, joint_names: tuple[str, ...]) -> np.ndarray:
    """The poses that a start may begin with."""
    return np.concatenate(
        [known_poses, [plain_pose(joint_names, angles) for angles in PLAIN_POSES]]
    )


def _nearest_of(frames: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """For each wanted frame the nearest of ``frames`` (sorted); itself where there are none."""
    if not len(frames):
        return targets
    after = np.clip(np.searchsorted(frames, targets), 1, max(1, len(frames) - 1)) % len(frames)
    before = frames[after - 1]
    return np.where(targets - before <= frames[after] - targets, before, frames[after])


def _upright_markers(rig: MarkedBody, pose: np.ndarray) -> np.ndarray:
    """Predicted markers (F, M, 3) of poses whose root is not turned, at the origin."""
    upright = np.concatenate([np.zeros_like(pose[:, :1]), pose[:, 1:]], axis=1)
    return predict(rig, upright, np.zeros((len(pose), 3)))


def _alignment(
    markers: np.ndarray, observed: np.ndarray, trunk: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation (F, 3, 3) and shift (F, 3) that take markers to the visible observed ones, both (F,
    M, 3) or one for all, and the mean distance (F,) that is left.
    """
    markers, observed = np.broadcast_arrays(markers, observed)
    weights = np.where(np.isfinite(observed[..., 0]), trunk, 0.0)
    weights[weights.sum(axis=1) == 0] = 1.0
    matrix, shift = procrustes(markers, np.nan_to_num(observed), weights)
    moved = markers @ np.swapaxes(matrix, 1, 2) + shift[:, None]
    distance = np.linalg.norm(moved - observed, axis=2)
    count = np.maximum(np.isfinite(distance).sum(axis=1), 1)
    return matrix, shift, np.nan_to_num(distance).sum(axis=1) / count


def _placed(
    rig: MarkedBody, pose: np.ndarray, matrix: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses with their root turned by matrices, and trans."""
    pivot = rig.rest_joints[0]
    root = rotvec_from_matrix(matrix)[:, None]
    return np.concatenate([root, pose[:, 1:]], axis=1), shift + matrix @ pivot - pivot


def align_root(
    rig: MarkedBody,
    pose: Float[np.ndarray, "F J 3"],
    observed: Float[np.ndarray, "F M 3"],
    trunk: Float[np.ndarray, " M"],
) -> tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F 3"]]:
    """``pose`` with its root turned, and trans, so that the trunk's markers fall on the observed
    ones (Procrustes).
    """
    matrix, shift, _ = _alignment(_upright_markers(rig, pose), observed, trunk)
    return _placed(rig, pose, matrix, shift)


def trunk_weights(
    body: BodyModel, vertices: Int[np.ndarray, " M"], settings: StartSettings = START
) -> Float[np.ndarray, " M"]:
    """Weights (M,) of the markers in the alignment of the root: 1 on the trunk."""
    on_trunk = [body.joint_names[joint] in TRUNK for joint in body.strongest_joint[vertices]]
    return np.where(on_trunk, 1.0, settings.off_trunk)
