"""Predicted markers and their derivatives (M equation 2), by compiled kernels.

`habitus.observe.markers` says the same in torch, which autodiff can differentiate.
"""

import numpy as np
from jaxtyping import Float

from habitus.kernels.simd import lane_array
from habitus.observe import plain_kernels as plain
from habitus.observe.marker_kernels import predict_frames
from habitus.observe.marker_rig import MarkerRig
from habitus.observe.marker_slots import lane_rig, pack_states, rows


def predict(
    rig: MarkerRig,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> Float[np.ndarray, "T M 3"]:
    """Markers predicted for T frames (M equation 2) in metres and the world; `soft_tissue` adds to the rig's betas."""
    pose, trans, soft_tissue = _states(rig, pose, trans, soft_tissue)
    fast = lane_rig(rig, soft_tissue.shape[1])
    at = rows(fast)
    states = pack_states(fast, trans, pose, soft_tissue)
    markers = np.empty((len(pose), rig.num_markers, 3))
    predict_frames(fast, at, lane_array(at.end), states, markers)
    return markers


def predict_plainly(
    rig: MarkerRig,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> Float[np.ndarray, "T M 3"]:
    """The slow twin of `predict`."""
    pose, trans, soft_tissue = _states(rig, pose, trans, soft_tissue)
    markers = np.empty((len(pose), rig.num_markers, 3))
    plain.predict_frames(rig, pose, trans, soft_tissue, markers)
    return markers


def marker_bases(
    rig: MarkerRig,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> Float[np.ndarray, "T M 3 3"]:
    """Bases (columns n, t, s) of the markers' triangles: the derivative of each marker to its coefficients."""
    pose, trans, soft_tissue = _states(rig, pose, trans, soft_tissue)
    bases = np.empty((len(pose), rig.num_markers, 3, 3))
    plain.bases_frames(rig, pose, trans, soft_tissue, bases)
    return bases


def linearize(
    rig: MarkerRig,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M 3 N"]]:
    """Predicted markers and their Jacobian for a few frames; N = 3 (trans) + 3 J (pose) + B if soft tissue is given.

    The coefficients of the markers stay fixed: the last B columns tell how a marker moves with the body's shape
    when it keeps its place in its triangle. Memory grows as T M 3 N: whole sequences are for
    `habitus.fit.mosh.sequence`.
    """
    columns = 0 if soft_tissue is None else np.shape(soft_tissue)[-1]
    pose, trans, soft_tissue = _states(rig, pose, trans, soft_tissue)
    markers = np.empty((len(pose), rig.num_markers, 3))
    jacobian = np.empty((len(pose), rig.num_markers, 3, 3 + 3 * rig.num_joints + columns))
    plain.linearize_frames(rig, pose, trans, soft_tissue, markers, jacobian)
    return markers, jacobian


def _states(rig, pose, trans, soft_tissue):
    """The three arrays as contiguous float64, soft tissue with zero columns when there is none."""
    pose = np.ascontiguousarray(pose, dtype=np.float64).reshape(-1, rig.num_joints, 3)
    trans = np.ascontiguousarray(trans, dtype=np.float64).reshape(len(pose), 3)
    soft_tissue = np.zeros((len(pose), 0)) if soft_tissue is None else soft_tissue
    return pose, trans, np.ascontiguousarray(soft_tissue, dtype=np.float64)
