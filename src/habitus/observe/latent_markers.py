"""Markers as a function of their positions on a body whose shape is still unknown (the shape stage
of MoSh, M 6).

One compiled kernel gives how markers move with betas and pose where it knows the body
(`habitus.observe.marker_rig`), else the body's surface Jacobian (`habitus.observe.markers`).
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.kernels.simd import lane_array
from habitus.observe.marker_jacobian_kernels import marker_columns
from habitus.observe.marker_kernels import predict_frames
from habitus.observe.marker_rig import (
    Offsets,
    SimdRig,
    Slots,
    kernels_cover,
    marker_rig,
    marker_slots,
    pack_states,
    simd_rig,
    workspace_offsets,
)
from habitus.observe.markers import (
    MarkerAttachment,
    MarkerJacobian,
    attach,
    carry,
    corner_weights,
    in_turn,
    marker_jacobian,
    predict_markers,
    predict_on_body,
    triangle_bases,
)


class LatentJacobian(NamedTuple):
    """Markers (m) and their derivatives; latent markers, not coefficients, are held. N = 3 J, per
    rad.
    """

    markers: Float[np.ndarray, "F M 3"]
    by_betas: Float[np.ndarray, "F M 3 B"]
    by_latent: Float[np.ndarray, "F M 3 3"]
    by_pose: Float[np.ndarray, "F M 3 N"]


class LatentMarkers:
    """M markers on given triangles (vertex ids): ``markers(betas, latent_markers, pose, trans)``
    are (F, M, 3).
    """

    def __init__(self, body: BodyModel, triangles: Int[np.ndarray, "M 3"]) -> None:
        corners = triangles.ravel()
        self.body = body
        self.triangles = triangles
        self._template, self._shapedirs = (
            np.asarray(each[corners]) for each in (body.v_template, body.shapedirs)
        )
        self._order = np.arange(len(corners)).reshape(-1, 3)

    def __call__(
        self,
        betas: Float[np.ndarray, " B"],
        latent_markers: Float[np.ndarray, "M 3"],
        pose: Float[np.ndarray, "F J 3"],
        trans: Float[np.ndarray, "F 3"],
    ) -> Float[np.ndarray, "F M 3"]:
        """The markers in F poses (rad) and places, metres."""
        attachment = self._at_rest(betas, latent_markers)[1]
        if not kernels_cover(self.body):
            return predict_on_body(self.body, attachment, betas, pose, trans)
        rig, _, offsets = self._arrays
        rig = rig._replace(coefficients=attachment.coefficients)
        states = pack_states(rig, trans, pose, np.broadcast_to(betas, (len(pose), len(betas))))
        found = np.empty((len(pose), attachment.num_markers, 3))
        predict_frames(rig, offsets, lane_array(offsets.end), states, found)
        return found

    def jacobian(self, betas, latent_markers, pose, trans) -> LatentJacobian:
        """The same with derivatives.

        With x = a + R c and c = R0ᵀ (m - a0): dx/dm = R R0ᵀ and dx/dbetas = ∂x/∂betas|c - R R0ᵀ
        ∂m/∂betas|c.
        """
        rest, attachment = self._at_rest(betas, latent_markers)
        posed = self._moved(attachment, betas, pose, trans)
        own = MarkerAttachment(self._order, attachment.coefficients)
        by_latent = posed.bases @ np.swapaxes(triangle_bases(rest, self._order).basis, -1, -2)
        rest_by_betas = carry(corner_weights(rest, own), self._shapedirs)
        return LatentJacobian(
            posed.markers, posed.by_betas - by_latent @ rest_by_betas, by_latent, posed.by_pose
        )

    def _moved(
        self, attachment: MarkerAttachment, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray
    ) -> MarkerJacobian:
        """Markers and derivatives with their coefficients held."""
        if not kernels_cover(self.body):
            return marker_jacobian(self.body, attachment, betas, pose, trans)
        rig, slots, offsets = self._arrays
        rig = rig._replace(coefficients=attachment.coefficients)
        shape = np.broadcast_to(betas, (len(pose), len(betas)))
        states = pack_states(rig, trans, pose, shape)
        corners = np.empty((len(pose), len(rig.rest_corners), 3))
        columns = np.zeros((len(pose), attachment.num_markers, 3, states.shape[1]))
        marker_columns(rig, slots, offsets, lane_array(offsets.end), states, corners, columns)
        corners = corners[:, rig.triangles.ravel()]
        own = in_turn(attachment)
        first = 3 + 3 * self.body.num_joints
        return MarkerJacobian(
            predict_markers(corners, own),
            columns[..., first : first + len(betas)],
            columns[..., 3:first],
            triangle_bases(corners, own.triangles).basis,
        )

    @cached_property
    def _arrays(self) -> tuple[SimdRig, Slots, Offsets]:
        """What the kernel takes: the mean person's rig, whose soft tissue is the whole shape."""
        count = self.body.num_betas
        held = MarkerAttachment(self.triangles, np.zeros(self.triangles.shape))
        rig = simd_rig(marker_rig(self.body, np.zeros(count), held), count)
        slots = marker_slots(rig)
        return rig, slots, workspace_offsets(rig, slots)

    def _at_rest(
        self, betas: np.ndarray, latent: np.ndarray
    ) -> tuple[np.ndarray, MarkerAttachment]:
        """Corners (3 M, 3) in the rest pose, and the markers attached."""
        corners = self._template + self._shapedirs @ betas
        coefficients = attach(latent, corners, None, triangles=self._order).coefficients
        return corners, MarkerAttachment(self.triangles, coefficients)
