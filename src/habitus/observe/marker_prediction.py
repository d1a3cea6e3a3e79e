"""Predicted markers of many frames (M equation 2): by compiled kernels where they know the body,
else by the body.

`habitus.observe.markers` states the marker function itself, for NumPy and torch.
"""

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.kernels.simd import lane_array
from habitus.observe.body_markers import BodyMarkers
from habitus.observe.marker_kernels import predict_frames
from habitus.observe.marker_rig import MarkerRig, kernels_cover, marker_rig
from habitus.observe.marker_slots import pack_states, simd_rig, workspace_offsets
from habitus.observe.markers import MarkerAttachment
from habitus.observe.soft_space import soft_directions
from habitus.parallel.blocks import mapped

MarkedBody = MarkerRig | BodyMarkers
"""A body of fixed shape with markers on it: as arrays for the compiled kernels, or as the body
itself.
"""


def marked_body(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    attachment: MarkerAttachment,
    space: str = "shape",
) -> MarkedBody:
    """A body of shape `betas` with markers on it, for the compiled kernels where they cover it.

    `space` (`habitus.observe.soft_space`): what its soft tissue is. The kernels know directions,
    whatever these are of.
    """
    if not kernels_cover(body):
        return BodyMarkers(body, betas, attachment, space)
    rig = marker_rig(body, betas, attachment)
    if space == "shape":
        return rig
    corners, joints = soft_directions(body, space, np.unique(attachment.triangles))
    return rig._replace(corner_shapedirs=corners, joint_shapedirs=joints)


def predict(
    marked: MarkedBody,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> Float[np.ndarray, "T M 3"]:
    """Markers predicted for T frames (M equation 2) in metres and the world; `soft_tissue` is of
    `marked`'s space.
    """
    soft = () if soft_tissue is None else (np.asarray(soft_tissue),)
    return mapped(
        lambda *frames: _predict(marked, *frames), np.asarray(pose), np.asarray(trans), *soft
    )


def _predict(
    marked: MarkedBody, pose: np.ndarray, trans: np.ndarray, soft_tissue: np.ndarray | None = None
) -> np.ndarray:
    pose = np.ascontiguousarray(pose, dtype=np.float64).reshape(-1, marked.num_joints, 3)
    trans = np.ascontiguousarray(trans, dtype=np.float64).reshape(len(pose), 3)
    if isinstance(marked, BodyMarkers):
        return marked.predict(pose, trans, soft_tissue)
    soft_tissue = (
        np.zeros((len(pose), 0))
        if soft_tissue is None
        else np.asarray(soft_tissue, dtype=np.float64)
    )
    rig = simd_rig(marked, soft_tissue.shape[1])
    offsets = workspace_offsets(rig)
    markers = np.empty((len(pose), marked.num_markers, 3))
    predict_frames(
        rig, offsets, lane_array(offsets.end), pack_states(rig, trans, pose, soft_tissue), markers
    )
    return markers
