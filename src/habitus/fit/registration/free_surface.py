"""The surface let free from the model: pulled to the scan, held together by a thin plate on its offset (T 5.4).

    sum_p w_p (n_p . (x(b_p) - t_p))^2 A / P + mu l^4 ( |M^-1/2 L d|^2 + d^T L' d / r^2 + |M^1/2 d|^2 / R^4 )

d = x - m; x are the vertices, m those of the model, L the cotangent Laplacian of m and M the areas of its vertices:
the plate bends over about l = 3 cm at mu = 1. L' is the same where there is no scan, 0 elsewhere: what is not seen goes
on as its border does, without the border's slope. The last term is there to have a solution at all. Points are drawn to
planes only, and it is the offset that is kept smooth, not the surface: both keep vertices from sliding.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_array, coo_array, csc_array, diags_array, eye_array, kron
from scipy.sparse.linalg import splu

from habitus.fit.registration.model_stage import Cloud
from habitus.fit.registration.nearest import Nearest, Topology, nearest
from habitus.fit.registration.weights import vertex_weights
from habitus.mesh.normals import face_normals
from habitus.residuals.robust import geman_mcclure_weight

PLATE = 1e-3 * 0.03**2
"""l^4, m^4."""
LEVEL, BACK = 0.03, 0.6
"""r and R, m."""
FINE = 0.012
"""Metres: where the mesh is finer, on fingers, toes and face, the plate is stiffer in proportion to the triangles."""
LEAST_COSINE = 0.5


@dataclass(frozen=True)
class FreeStep:
    """One solve: how stiff the plate is, and beyond which distance (m) a point hardly counts."""

    stiffness: float
    reach: float


STEPS = (FreeStep(1.0, 0.03), FreeStep(0.1, 0.02), FreeStep(0.01, 0.01))


def free_surface(
    topology: Topology,
    model: Float[np.ndarray, "V 3"],
    cloud: Cloud,
    steps: Sequence[FreeStep] = STEPS,
    start: Float[np.ndarray, "V 3"] | None = None,
) -> Float[np.ndarray, "V 3"]:
    """The free vertices (m) of a scan whose model's are ``model``; they begin there, or at ``start``."""
    laplacian, area = cotangent_laplacian(model, topology.faces)
    stiff = np.maximum(1.0, FINE**2 / area) / area
    plate = laplacian.T @ diags_array(stiff) @ laplacian + diags_array(area / BACK**4)
    surface = model if start is None else start
    for step in steps:
        unseen = 1.0 - vertex_weights(topology, surface, cloud)[topology.faces].min(1)
        level = cotangent_laplacian(model, topology.faces, unseen)[0] / LEVEL**2
        held = kron(PLATE * (plate + level), eye_array(3), format="csc")
        found = nearest(topology, surface, cloud.points, cloud.normals)
        rows, apart, weight = _pulls(topology, model, cloud, found, step.reach)
        weight = weight * area.sum() / len(weight)
        pulled = csc_array(rows.T @ diags_array(weight) @ rows)
        factor = splu(pulled + step.stiffness * held, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        surface = model + factor.solve(rows.T @ (weight * apart)).reshape(-1, 3)
    return surface


def _pulls(
    topology: Topology, model: np.ndarray, cloud: Cloud, found: Nearest, reach: float
) -> tuple[bsr_array, Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Rows (P, 3 V) of n_p . x(b_p), what they should be beyond the model's, and weights."""
    corners = topology.faces[found.face]
    distance = np.linalg.norm(cloud.points - found.place, axis=1)
    weight = geman_mcclure_weight(distance, reach) * (found.cosine > LEAST_COSINE)
    blocks = (found.barycentric[..., None] * found.normal[:, None]).reshape(-1, 1, 3)
    ends = np.arange(0, 3 * len(corners) + 1, 3)
    rows = bsr_array((blocks, corners.ravel(), ends), shape=(len(corners), 3 * len(model))).tocsr()
    start = np.einsum("pk,pkc->pc", found.barycentric, model[corners])
    return rows, ((cloud.points - start) * found.normal).sum(1), weight


def cotangent_laplacian(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    share: Float[np.ndarray, " F"] | None = None,
) -> tuple[csc_array, Float[np.ndarray, " V"]]:
    """The cotangent Laplacian (V, V; positive semidefinite) and the areas of vertices, m^2: a third of their faces'.

    ``share``: how much each face counts in the Laplacian.
    """
    count, corners = len(vertices), vertices[faces]
    double = np.maximum(np.linalg.norm(face_normals(vertices, faces), axis=1), 1e-12)
    rows, columns, values = [], [], []
    for k in range(3):
        i, j = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        a, b = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        half = np.clip(0.5 * (a * b).sum(1) / double, -10.0, 10.0) * (1.0 if share is None else share)
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        values += [-half, -half, half, half]
    area = np.bincount(faces.ravel(), np.repeat(double / 6.0, 3), count)
    table = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csc_array(coo_array(table, shape=(count, count))), np.maximum(area, 1e-9)
