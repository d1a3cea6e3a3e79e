"""Markers of a body whose shape is still unknown, as a function of their places in the rest pose (M
equation 2).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.observe.marker_jacobian import carry, corner_weights, marker_jacobian, predict_on_body
from habitus.observe.markers import MarkerAttachment, attach, triangle_bases


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
        return predict_on_body(
            self.body, self._at_rest(betas, latent_markers)[1], betas, pose, trans
        )

    def jacobian(self, betas, latent_markers, pose, trans) -> LatentJacobian:
        """The same with derivatives.

        With x = a + R c and c = R0ᵀ (m - a0): dx/dm = R R0ᵀ and dx/dbetas = ∂x/∂betas|c - R R0ᵀ
        ∂m/∂betas|c.
        """
        rest, attachment = self._at_rest(betas, latent_markers)
        posed = marker_jacobian(self.body, attachment, betas, pose, trans)
        own = MarkerAttachment(self._order, attachment.coefficients)
        by_latent = posed.bases @ np.swapaxes(triangle_bases(rest, self._order).basis, -1, -2)
        rest_by_betas = carry(corner_weights(rest, own), self._shapedirs)
        return LatentJacobian(
            posed.markers, posed.by_betas - by_latent @ rest_by_betas, by_latent, posed.by_pose
        )

    def _at_rest(
        self, betas: np.ndarray, latent: np.ndarray
    ) -> tuple[np.ndarray, MarkerAttachment]:
        """Corners (3 M, 3) in the rest pose, and the markers attached."""
        corners = self._template + self._shapedirs @ betas
        coefficients = attach(latent, corners, None, triangles=self._order).coefficients
        return corners, MarkerAttachment(self.triangles, coefficients)
