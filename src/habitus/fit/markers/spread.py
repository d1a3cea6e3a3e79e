"""How well a fit knows the shape: the covariance of its betas, as the markers' places allow."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from habitus.observe.body_markers import BodyMarkers

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

PLACE = 0.015
"""Standard deviation (m) of a marker's place on a real body about its place on the fitted one:
hands that placed it, flesh, and a shape space that knows no body exactly.
"""
_FREE = 1.0  # radians and metres: how far pose and trans may move to make up for a change of shape


def betas_covariance(fit: "MarkerFit", place: float = PLACE) -> Float[np.ndarray, "B B"]:
    """The betas' posterior covariance (B, B): standard normal, seen through markers in one frame of
    free pose.

    Markers are off their places by ``place`` and by their noise. Frames do not make this less, as a
    marker is off alike in all of them; so the frame that sees most markers stands for all.
    """
    count = len(fit.betas)
    frame = int(np.argmax(fit.visible.sum(axis=1)))
    seen = fit.visible[frame] & np.isfinite(fit.marker_noise)
    rig = BodyMarkers(fit.body, fit.betas, fit.attachment)
    with_pose = rig.jacobian(fit.pose[[frame]], fit.trans[[frame]])
    shape = with_pose.by_betas[0][seen].reshape(-1, count)
    moved = np.concatenate(
        [with_pose.by_pose[0][seen].reshape(len(shape), -1), np.tile(np.eye(3), (seen.sum(), 1))], 1
    )
    weight = np.repeat(1.0 / np.sqrt(place**2 + fit.marker_noise[seen] ** 2), 3)[:, None]
    shape = weight * shape
    moved = weight * moved
    both = moved.T @ shape
    left = shape.T @ shape - both.T @ np.linalg.solve(
        moved.T @ moved + np.eye(moved.shape[1]) / _FREE**2, both
    )
    return np.linalg.inv(np.eye(count) + 0.5 * (left + left.T))
