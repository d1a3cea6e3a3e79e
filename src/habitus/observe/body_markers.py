"""Markers on any body of fixed shape, by the body's own functions in batches of frames.

The compiled kernels (`habitus.observe.marker_rig`) know bodies that are skinned linearly with
SMPL's pose blend shapes; this path takes dual quaternions and other pose features as well.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.observe.marker_jacobian import (
    MarkerJacobian,
    marker_jacobian,
    predict_on_body,
    rest_joints,
)
from habitus.observe.markers import MarkerAttachment
from habitus.observe.soft_space import SPACES, parted, soft_count

BATCH = 16
"""Frames evaluated together."""


@dataclass(frozen=True, eq=False)
class BodyMarkers:
    """A body of shape `betas` (B,) and the markers on it; the counterpart of `MarkerRig` for bodies
    of every kind.

    `space` (`habitus.observe.soft_space`): what the S coefficients of soft tissue are.
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
        shapes, moving = self._shapes(len(pose), soft_tissue)
        found = [
            predict_on_body(
                self.body,
                self.attachment,
                shapes[part],
                pose[part],
                trans[part],
                _part(moving, part),
            )
            for part in _batches(len(pose))
        ]
        return np.concatenate(found) if found else np.zeros((0, self.num_markers, 3))

    def jacobian(
        self,
        pose: Float[np.ndarray, "T J 3"],
        trans: Float[np.ndarray, "T 3"],
        soft_tissue: Float[np.ndarray, "T S"] | None = None,
    ) -> MarkerJacobian:
        """The same with derivatives, by betas those of soft tissue, coefficients held; memory: 3 T
        M (3 J + S).
        """
        shapes, moving = self._shapes(len(pose), soft_tissue)
        found = [
            marker_jacobian(
                self.body,
                self.attachment,
                shapes[part],
                pose[part],
                trans[part],
                _part(moving, part),
            )
            for part in _batches(len(pose))
        ]
        joined = MarkerJacobian(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
        unused = 0 if "shape" in SPACES[self.space] else len(self.betas)
        return joined._replace(by_betas=joined.by_betas[..., unused:])

    def _shapes(
        self, frames: int, soft_tissue: np.ndarray | None
    ) -> tuple[Float[np.ndarray, "T B"], Float[np.ndarray, "T D"] | None]:
        soft = np.zeros((frames, self.num_betas)) if soft_tissue is None else soft_tissue
        change, moving = parted(self.body, self.space, soft)
        return np.broadcast_to(self.betas, (frames, len(self.betas))) + change, moving


def _part(array: np.ndarray | None, part: slice) -> np.ndarray | None:
    return None if array is None else array[part]


def _batches(frames: int) -> list[slice]:
    return [slice(first, first + BATCH) for first in range(0, frames, BATCH)]
