"""Predicted markers of many frames (M equation 2): by compiled kernels where they know the body,
else by the body's own functions in batches of frames.

The compiled kernels (`habitus.observe.marker_rig`) know bodies that are skinned linearly with
SMPL's pose blend shapes; `BodyMarkers` takes dual quaternions and other pose features as well.
`habitus.observe.markers` states the marker function itself, for NumPy and torch.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.soft_tissue import SPACES, parted, soft_count, soft_directions
from habitus.kernels.simd import lane_array
from habitus.observe.marker_kernels import predict_frames
from habitus.observe.marker_rig import (
    MarkerRig,
    kernels_cover,
    marker_rig,
    pack_states,
    simd_rig,
    workspace_offsets,
)
from habitus.observe.markers import (
    MarkerAttachment,
    MarkerJacobian,
    marker_jacobian,
    predict_on_body,
    rest_joints,
)
from habitus.parallel.blocks import mapped

Part = TypeVar("Part")

BATCH = 16
"""Frames evaluated together."""


@dataclass(frozen=True, eq=False)
class BodyMarkers:
    """A body of shape `betas` (B,) and the markers on it; the counterpart of `MarkerRig` for bodies
    of every kind.

    `space` (`habitus.body.soft_tissue`): what the S coefficients of soft tissue are.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    attachment: MarkerAttachment
    space: str = "shape"

    @property
    def num_joints(self) -> int:
        """J."""
        return self.body.num_joints

    @property
    def num_markers(self) -> int:
        """M."""
        return self.attachment.num_markers

    @property
    def num_betas(self) -> int:
        """S: B, where the shape is let go."""
        return soft_count(self.body, self.space)

    @property
    def rest_joints(self) -> Float[np.ndarray, "J 3"]:
        """Joints at rest, metres."""
        return rest_joints(self.body, self.betas)

    def predict(
        self,
        pose: Float[np.ndarray, "T J 3"],
        trans: Float[np.ndarray, "T 3"],
        soft_tissue: Float[np.ndarray, "T S"] | None = None,
    ) -> Float[np.ndarray, "T M 3"]:
        """Markers of T frames; `soft_tissue` adds to the betas, or is of another `space`."""
        parts = self._in_batches(predict_on_body, pose, trans, soft_tissue)
        return np.concatenate(parts) if parts else np.zeros((0, self.num_markers, 3))

    def jacobian(
        self,
        pose: Float[np.ndarray, "T J 3"],
        trans: Float[np.ndarray, "T 3"],
        soft_tissue: Float[np.ndarray, "T S"] | None = None,
    ) -> MarkerJacobian:
        """The same with derivatives, by betas those of soft tissue, coefficients held; memory: 3 T
        M (3 J + S).
        """
        parts = self._in_batches(marker_jacobian, pose, trans, soft_tissue)
        joined = MarkerJacobian(*(np.concatenate(each) for each in zip(*parts, strict=True)))
        unused = 0 if "shape" in SPACES[self.space] else len(self.betas)
        return joined._replace(by_betas=joined.by_betas[..., unused:])

    def _in_batches(
        self,
        function: Callable[..., Part],
        pose: np.ndarray,
        trans: np.ndarray,
        soft_tissue: np.ndarray | None,
    ) -> list[Part]:
        """``function`` of the body, the attachment and the states of `BATCH` frames at a time."""
        soft = np.zeros((len(pose), self.num_betas)) if soft_tissue is None else soft_tissue
        change, moving = parted(self.body, self.space, soft)
        shapes = np.broadcast_to(self.betas, (len(pose), len(self.betas))) + change
        rows = [slice(first, first + BATCH) for first in range(0, len(pose), BATCH)]
        return [
            function(
                self.body,
                self.attachment,
                shapes[part],
                pose[part],
                trans[part],
                None if moving is None else moving[part],
            )
            for part in rows
        ]


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

    `space` (`habitus.body.soft_tissue`): what its soft tissue is. The kernels know directions,
    whatever these are of.
    """
    if not kernels_cover(body):
        return BodyMarkers(body, betas, attachment, space)
    rig = marker_rig(body, betas, attachment)
    if space == "shape":
        return rig
    corners, joints = soft_directions(body, space, np.unique(attachment.triangles))
    folds = rig.corner_fold_shapes[..., : None if "shape" in SPACES[space] else 0]
    return rig._replace(corner_shapedirs=corners, joint_shapedirs=joints, corner_fold_shapes=folds)


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
