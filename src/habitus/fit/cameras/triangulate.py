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
BLOCK = 20_000
"""Points that are treated together: what they need fits into a processor's cache."""
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
    count, *shape = confidence.shape
    reaches = np.broadcast_to(reach, confidence.shape).reshape(count, -1)
    flat, sure = pixels.reshape(count, -1, 2), confidence.reshape(count, -1)
    points, errors = np.empty((flat.shape[1], 3)), np.empty(sure.shape)
    for first in range(0, len(points), BLOCK):
        own = slice(first, first + BLOCK)
        points[own], errors[:, own] = _triangulated(
            rig, flat[:, own], sure[:, own], reaches[:, own]
        )
    return points.reshape(*shape, 3), errors.reshape(confidence.shape)


def _triangulated(
    rig: CameraRig,
    pixels: Float[np.ndarray, "C N 2"],
    confidence: Float[np.ndarray, "C N"],
    reach: Float[np.ndarray, "C N"],
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "C N"]]:
    """`triangulated` of one block."""
    seen = np.isfinite(pixels).all(-1) & (confidence > 0.0)
    direction = rays(rig, np.where(seen[..., None], pixels, rig.centre.mean()))
    origin = rig.places[:, None]
    across = origin - direction * np.einsum("cni,ci->cn", direction, rig.places)[..., None]
    weight = np.where(seen, confidence, 0.0)
    robust = np.ones_like(weight)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            own = weight * robust
            total = own.sum(0)
            right = np.einsum("cn,cni->ni", own, across)
            weighed = own[..., None] * direction
            matrix = -np.einsum("cni,cnj->nij", weighed, direction)
            matrix[:, range(3), range(3)] += total[:, None]
            points, determinant = _solved(matrix, right)
            points[~(determinant > MIN_DETERMINANT * total**3)] = np.nan
            error = np.linalg.norm(rig.project(points) - pixels, axis=-1)
            robust = np.nan_to_num(geman_mcclure_weight(error, reach))
            depth = np.linalg.norm(points - origin, axis=-1)
            weight = np.where(seen, np.nan_to_num(confidence / depth**2), 0.0)
    agree = (seen & (error < reach)).sum(0) >= 2
    return np.where(agree[..., None], points, np.nan), np.where(seen, error, np.nan)


def _solved(
    matrix: Float[np.ndarray, "N 3 3"], right: Float[np.ndarray, "N 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Solutions of symmetric equations by Cramer's rule, and the determinants."""
    x, y, z = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    minors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
    determinant = np.einsum("ni,ni->n", x, minors[:, 0])
    return np.einsum("nij,ni->nj", minors, right) / determinant[:, None], determinant
