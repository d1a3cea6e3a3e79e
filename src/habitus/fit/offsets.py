"""Skin offsets: how far a person's skin lies off a body model, along the model's normals.

    h ~ N(0, Q^-1),    k = sqrt(8 s) / range,    K = k^2 A + L
    Q = S^-1 (K A^-1)^s K S^-1 / (4 pi s k^(2 s))

h (V,; m) is a Gaussian random field on the surface of Matern's kind with smoothness s (Lindgren,
Rue and Lindstroem 2011), L the cotangent Laplacian, A the areas of vertices and S the standard
deviation of h at each. What a fit leaves of a scan is correlated over centimetres: without h a
thousand points on a thigh count as a thousand independent measurements, and the model slides along
the skin after them.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from habitus.body.jacobians import SurfaceJacobian
from habitus.body.model import BodyModel
from habitus.fit.offset_kernels import substitute_forward
from habitus.mesh.laplacian import cotangent_laplacian
from habitus.mesh.normals import vertex_normals


@dataclass(frozen=True)
class OffsetSettings:
    """The prior of skin offsets; lengths in metres. Measured on registered scans of people whom no
    body model made (CHANGELOG).
    """

    sd: float = 0.004
    """Standard deviation of the offset."""
    bony_sd: float = 0.002
    """The same on bony parts, where little flesh lies under the skin."""
    bony: tuple[str, ...] = ("hand", "wrist", "foot", "head", "toe")
    """Last words of the joints that move bony parts."""
    range: float = 0.19
    """Distance at which the correlation of two offsets is 0.14."""


OFFSETS = OffsetSettings()


def offset_spread(body: BodyModel, settings: OffsetSettings = OFFSETS) -> Float[np.ndarray, " V"]:
    """The offset's standard deviation (m) at each vertex."""
    bony = [
        k for k, name in enumerate(body.joint_names) if name.rpartition("_")[2] in settings.bony
    ]
    share = body.skinning_weights[:, bony].sum(1)
    return settings.sd * (1.0 - share) + settings.bony_sd * share


def field_precision(
    faces: Int[np.ndarray, "F 3"],
    vertices: Float[np.ndarray, "V 3"],
    spread: Float[np.ndarray, " V"],
    correlation_range: float = OFFSETS.range,
    smoothness: int = 1,
) -> csc_array:
    """The precision Q (V, V; 1 / m^2) of a Matern field on a mesh with that standard deviation
    (m), range (m) and integer smoothness.
    """
    laplacian, area = cotangent_laplacian(vertices, faces)
    inverse = np.sqrt(8.0 * smoothness) / correlation_range
    whole = half = inverse**2 * diags_array(area) + laplacian
    for _ in range(smoothness):
        whole = whole @ diags_array(1.0 / area) @ half
    whole = whole / (4.0 * np.pi * smoothness * inverse ** (2 * smoothness))
    return csc_array(diags_array(1.0 / spread) @ whole @ diags_array(1.0 / spread))


def field_basis(precision: csc_array, places: Int[np.ndarray, " C"]) -> Float[np.ndarray, "V C"]:
    """Z with h = Z z, z ~ N(0, I): the field given its values at some vertices (Nystroem)."""
    count = precision.shape[0]  # pyright: ignore[reportOptionalSubscript]  (SciPy has no annotations)
    unit = csc_array((np.ones(len(places)), (places, np.arange(len(places)))), (count, len(places)))
    covariance = factored(precision).solve(unit.toarray())
    root = np.linalg.cholesky(covariance[places] + 1e-9 * np.eye(len(places)))
    return np.linalg.solve(root, covariance.T).T


def along_normals(
    surfaces: Float[np.ndarray, "*K V 3"], offset: Float[np.ndarray, " V"], body: BodyModel
) -> Float[np.ndarray, "*K V 3"]:
    """Surfaces moved along their normals (m)."""
    return surfaces + offset[:, None] * vertex_normals(surfaces, body.faces)


def motion_along(
    normals: Float[np.ndarray, "U 3"], jacobian: SurfaceJacobian
) -> Float[np.ndarray, "U P"]:
    """How U vertices move along their normals with betas, trans and pose."""
    count = len(normals)
    by_betas, by_pose = (
        np.einsum(
            "vc,vcn->vn", normals, each.reshape(count, 3, math.prod(each.shape[2:])), optimize=True
        )
        for each in (jacobian.vertices_betas, jacobian.vertices_pose)
    )
    return np.concatenate([by_betas, normals, by_pose], 1)


def factored(matrix: csc_array) -> SuperLU:
    """The factors of a symmetric positive definite matrix, without pivots off its diagonal, which
    would fill it.
    """
    return splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def inverse_product(factor: SuperLU, rows: Float[np.ndarray, "V n"]) -> Float[np.ndarray, "n n"]:
    """R^T A^-1 R of a symmetric matrix A (V, V) with the factors of `factored`.

    With A = L D L^T up to the order of its rows it is X^T X, X = D^-1/2 L^-1 R: half of a solve,
    for all columns of R at once.
    """
    half = np.empty_like(rows, order="C")
    half[factor.perm_r] = rows
    lower = factor.L
    substitute_forward(lower.indptr, lower.indices, lower.data, half)
    half /= np.sqrt(factor.U.diagonal())[:, None]
    return half.T @ half
