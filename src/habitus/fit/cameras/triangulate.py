"""Points in space from pixels of several cameras, by least squares over the rays, re-weighted: a
start of fits, and what people are told apart by.

    argmin_q sum_c w_c |(I - d_c d_c') (q - o_c)|^2

o_c is a camera's place, d_c the direction of its ray; w_c = v_c / depth^2, so that pixels count,
times Geman-McClure's weight of the reprojection error.
"""

import numpy as np
from jaxtyping import Float

from habitus.observe.camera_rig import CameraRig
from habitus.solve.terms import geman_mcclure_weight

STEPS = 4
MIN_DETERMINANT = 1e-4
"""Of a point's normal matrix, relative to its weight: rays within some 1 degree of each other do
not tell a depth."""


def rays(rig: CameraRig, pixels: Float[np.ndarray, "C *any 2"]) -> Float[np.ndarray, "C *any 3"]:
    """Unit directions in the world of ideal pixels."""
    shape = (len(rig.cameras), *[1] * (pixels.ndim - 2), 2)
    plane = (pixels - rig.centre.reshape(shape)) / rig.focal.reshape(shape)
    own = np.concatenate([plane, np.ones_like(plane[..., :1])], -1)
    world = np.einsum("cij,c...i->c...j", rig.rotation, own)
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def triangulated(
    rig: CameraRig,
    pixels: Float[np.ndarray, "C *any 2"],
    confidence: Float[np.ndarray, "C *any"],
    reach: Float[np.ndarray, "C *#any"] | float = 30.0,
) -> tuple[Float[np.ndarray, "*any 3"], Float[np.ndarray, "C *any"]]:
    """Points (m), NaN where fewer than two cameras agree, and each camera's reprojection error (px;
    NaN where it saw nothing). reach: of the robust loss, px.
    """
    seen = np.isfinite(pixels).all(-1) & (confidence > 0.0)
    direction = rays(rig, np.where(seen[..., None], pixels, rig.centre.mean()))
    origin = rig.places.reshape(len(rig.cameras), *[1] * (pixels.ndim - 2), 3)
    project = np.eye(3) - direction[..., None] * direction[..., None, :]
    weight = np.where(seen, confidence, 0.0)
    robust = np.ones_like(weight)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            matrix = ((weight * robust)[..., None, None] * project).sum(0)
            right = (
                (weight * robust)[..., None]
                * np.einsum("...ij,...j->...i", project, np.broadcast_to(origin, direction.shape))
            ).sum(0)
            total = (weight * robust).sum(0)
            sound = np.linalg.det(matrix) > MIN_DETERMINANT * total**3
            matrix = np.where(sound[..., None, None], matrix, np.eye(3))
            points = np.linalg.solve(matrix, right[..., None])[..., 0]
            points = np.where(sound[..., None], points, np.nan)
            error = np.linalg.norm(rig.project(points) - pixels, axis=-1)
            robust = np.nan_to_num(geman_mcclure_weight(error, reach))
            depth = np.linalg.norm(points - origin, axis=-1)
            weight = np.where(seen, np.nan_to_num(confidence / depth**2), 0.0)
    agree = (seen & (error < reach)).sum(0) >= 2
    return np.where(agree[..., None], points, np.nan), np.where(seen, error, np.nan)
