"""What of a pose the keypoints that were seen determine, bone by bone, and what is the prior's.

At some frames of a fit, H is the Gauss-Newton matrix of the pixels and P the prior's precision, so
that the pose has the covariance (H + P)^-1. A bone's ``turn`` is its rotation about its own axis
(from the joint to the middle of its skin), its ``place`` the rotation across it. Two numbers of
each are the medians over the frames:

    sd    = sqrt(max eigenvalue of G (H + P)^-1 G^T)             in the world
    share = tr(A (H + P)^-1 A^T) / tr(A P^-1 A^T)                relative to the bone above

share is how much of the variance that people have remains once the keypoints are known. A bone is
open (`OPEN`) where much of it remains and sd says that the bone might as well be elsewhere.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.prior import prior_of
from habitus.fit.cameras.review import Sight, information
from habitus.fit.cameras.sequence import KeypointSequence, keypoint_data
from habitus.fit.cameras.settings import CAMERAS, CameraSettings
from habitus.fit.cameras.solution import CameraSolution
from habitus.observe.keypoints import KeypointRig
from habitus.rotations import left_jacobian, matrix_from_rotvec

FRAMES = 24
"""Of the motion, evenly spread."""
OPEN = ((0.5, 13.0), (0.9, 8.0))
"""A share and an sd (degrees) above which, for one of these pairs, keypoints determine nothing."""
ROOT_INFORMATION = 1e-6
"""Of the root, which has no prior (1 / m^2, 1 / rad^2)."""


class Open(NamedTuple):
    """Bones, by their joints, of which no keypoint determines where they point, ``place``, or else
    the ``turn`` about their own axis.
    """

    place: Bool[np.ndarray, " J"]
    turn: Bool[np.ndarray, " J"]


class Determined(NamedTuple):
    """Of each joint's bone what remains of the variance (shares) and how far it may be off
    (degrees): of where it points and of the turn about its own axis. Shares of the root are 0.
    """

    place_share: Float[np.ndarray, " J"]
    turn_share: Float[np.ndarray, " J"]
    place_sd: Float[np.ndarray, " J"]
    turn_sd: Float[np.ndarray, " J"]

    @property
    def open(self) -> Open:
        """What no keypoint determines."""
        place = _is_open(self.place_share, self.place_sd)
        return Open(place, _is_open(self.turn_share, self.turn_sd) & ~place)


def _is_open(share: Float[np.ndarray, " J"], sd: Float[np.ndarray, " J"]) -> Bool[np.ndarray, " J"]:
    return np.any([(share > least) & (sd > off) for least, off in OPEN], axis=0)


def determined(fit: CameraSolution, settings: CameraSettings = CAMERAS) -> Determined:
    """By the keypoints that each camera saw in some frames of the fit."""
    frames = np.unique(np.linspace(0, len(fit.pose) - 1, FRAMES).round().astype(int))
    pose = fit.pose[frames]
    prior = prior_of(fit.body).for_joints(fit.body.joint_names)
    matrices = _pixels(fit, frames, settings)
    matrices += np.eye(matrices.shape[1]) * ROOT_INFORMATION
    matrices[:, 6:, 6:] += prior.precision
    known = np.linalg.inv(matrices)[:, 3:, 3:]
    person = KeypointRig.of(fit.body, fit.keypoint_names, fit.convention).shaped(
        fit.betas, fit.keypoint_places
    )
    world = person.skeleton(pose, fit.trans[frames])[0]
    axes = bone_axes(fit)
    joints = len(axes)
    own = left_jacobian(pose)
    turns = own.copy()  # of the bones, in the world, by the joints' rotation vectors
    turns[:, 1:] = world[:, np.maximum(person.parents[1:], 0)] @ own[:, 1:]
    found = np.zeros((4, len(frames), joints))
    for j in range(joints):
        way = np.zeros((len(frames), 3, 3 * joints))
        i = j
        while i >= 0:
            way[:, :, 3 * i : 3 * i + 3] = turns[:, i]
            i = int(person.parents[i])
        found[2:, :, j] = _spread(way @ known @ way.transpose(0, 2, 1), world[:, j] @ axes[j])
        if j:
            rows = slice(3 * j, 3 * j + 3)
            usual = prior.covariance[3 * j - 3 : 3 * j, 3 * j - 3 : 3 * j]
            flip = own[:, j].transpose(0, 2, 1)
            axis = matrix_from_rotvec(pose[:, j]) @ axes[j]
            after = _parts(own[:, j] @ known[:, rows, rows] @ flip, axis)
            before = _parts(own[:, j] @ usual @ flip, axis)
            found[:2, :, j] = after / before
    return Determined(*np.median(found, axis=1))


def _pixels(
    fit: CameraSolution, frames: np.ndarray, settings: CameraSettings
) -> Float[np.ndarray, "F N N"]:
    """Gauss-Newton matrices of what cameras saw, by place and pose."""
    assert fit.cameras is not None
    keypoints = KeypointRig.of(fit.body, fit.keypoint_names, fit.convention)
    count = fit.confidence.shape[1:]
    sight = Sight(
        fit.observed[frames],
        fit.confidence[frames],
        fit.size_px[frames],
        np.ones(count),
        np.zeros(count[0]),
        np.zeros((len(frames), count[0]), bool),
    )
    nothing = 3 * (fit.body.num_joints - 1)
    data = keypoint_data(
        keypoints.shaped(fit.betas, fit.keypoint_places),
        fit.cameras,
        sight.pixels,
        information(sight, keypoints, settings.noise),
        np.zeros(nothing),
        np.zeros((nothing, nothing)),
        settings.reach,
    )
    states = np.concatenate([fit.trans[frames], fit.pose[frames].reshape(len(frames), -1)], 1)
    problem = KeypointSequence(data, np.zeros(states.shape[1]))
    return problem.linearize(np.arange(len(frames)), states)[2]


def _parts(
    covariance: Float[np.ndarray, "F 3 3"], axis: Float[np.ndarray, "F 3"]
) -> Float[np.ndarray, "2 F"]:
    """The variance across an axis, summed, and along it."""
    along = np.einsum("fi,fij,fj->f", axis, covariance, axis)
    return np.stack([np.trace(covariance, axis1=1, axis2=2) - along, along])


def _spread(
    covariance: Float[np.ndarray, "F 3 3"], axis: Float[np.ndarray, "F 3"]
) -> Float[np.ndarray, "2 F"]:
    """Standard deviations (degrees): the largest across an axis, and along it."""
    flat = np.eye(3) - axis[:, :, None] * axis[:, None]
    across = np.linalg.eigvalsh(flat @ covariance @ flat)[:, -1]
    along = _parts(covariance, axis)[1]
    return np.degrees(np.sqrt(np.maximum(np.stack([across, along]), 0.0)))


def bone_axes(fit: CameraSolution) -> Float[np.ndarray, "J 3"]:
    """Unit directions at rest from each joint to the middle of the skin that moves with it."""
    body = fit.body
    middle = _skin_weights(fit).T @ body.rest_vertices(fit.betas)
    total = _skin_weights(fit).sum(0)[:, None]
    joints = np.asarray(body.rest_joints(fit.betas))
    away = middle / np.maximum(total, 1e-9) - joints
    long = np.linalg.norm(away, axis=1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    return np.where((total > 1e-6) & (long > 1e-4), away / np.maximum(long, 1e-9), up)


def _skin_weights(fit: CameraSolution) -> Float[np.ndarray, "V J"]:
    """Of each vertex by joint."""
    body = fit.body
    index, value = np.asarray(body.skinning_index), np.asarray(body.skinning_value)
    table = np.zeros((body.num_vertices, body.num_joints))
    np.add.at(table, (np.arange(len(table))[:, None], index), value)
    return table


def open_skin(fit: CameraSolution, bones: Bool[np.ndarray, " J"]) -> Bool[np.ndarray, " V"]:
    """Vertices that move with these bones, by half or more."""
    return _skin_weights(fit) @ bones >= 0.5
