"""The surface let free from the model: moved along the model's normals to the scan, held by a thin
plate (T 5.4).

    sum_p w_p (n_p . (x(b_p) - t_p))^2 A / P + mu l^4 ( E(h) + b E(h n) ),
    E(h) = |M^-1/2 L h|^2 + h^T L' h / r^2 + |M^1/2 h|^2 / R^4

x = m + h n; m are the model's vertices, n its normals and h (V,) how far each goes along its own, L
the cotangent Laplacian of m and M the areas of its vertices: the plate bends over about l = 3 cm at
mu = 1. L' is the same where there is no scan, 0 elsewhere: what is not seen goes on as its border
does, without the border's slope. The last term is there to have a solution at all. E(h n), the same
of the offset as a vector, keeps what is thin or creased from swelling into itself. A scan without
colours tells nothing of places along the skin beyond what the model found in it: a plate on offsets
in all directions slides a calf's skin to the side sooner than it lets it swell.

A free surface that cuts itself nowhere that its model does not: at lips, toes and armpits, where
skin meets skin.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import SuperLU, splu

from habitus.fit.points.correspondences import Nearest, Topology, nearest, vertex_weights
from habitus.fit.points.scan import Cloud
from habitus.mesh.intersections import intersecting_pairs
from habitus.mesh.laplacian import cotangent_laplacian
from habitus.mesh.normals import vertex_normals
from habitus.residuals.robust import geman_mcclure_weight

PLATE = 1e-3 * 0.03**2
"""l^4, m^4."""
LEVEL, RETURN = 0.03, 0.6
"""r and R, m."""
CREASE = 0.1
"""b."""
FINE = 0.012
"""Metres: where the mesh is finer, on fingers, toes and face, the plate is stiffer in proportion to
the triangles.
"""
LEAST_COSINE = 0.5


@dataclass(frozen=True)
class FreeStep:
    """One solve: how stiff the plate is, and beyond which distance (m) a point hardly counts."""

    stiffness: float
    reach: float


STEPS = (FreeStep(0.1, 0.02), FreeStep(0.01, 0.01), FreeStep(0.003, 0.01))
STRETCH_STEPS = (FreeStep(0.1, 0.03), FreeStep(0.01, 0.02), FreeStep(0.003, 0.01))


def free_surface(
    topology: Topology,
    model: Float[np.ndarray, "V 3"],
    cloud: Cloud,
    steps: Sequence[FreeStep] = STEPS,
    start: Float[np.ndarray, "V 3"] | None = None,
) -> Float[np.ndarray, "V 3"]:
    """The free vertices (m) of a scan whose model's are ``model``; they begin there, or at
    ``start``.
    """
    plate, area = _plate(topology, model)
    normal = vertex_normals(model, topology.faces)
    surface = model if start is None else start
    for step in steps:
        held = _creased(PLATE * (plate + _level(topology, model, surface, cloud)), normal)
        found = nearest(topology, surface, cloud.points, cloud.normals)
        rows, apart = _pulls(topology, model, normal, cloud, found)
        weight = _weights(cloud, found, step.reach) * area.sum() / len(apart)
        surface = model + _solved(rows, weight, apart, step.stiffness * held)[:, None] * normal
    return surface


def stretched_surface(
    topology: Topology,
    surface: Float[np.ndarray, "V 3"],
    cloud: Cloud,
    steps: Sequence[FreeStep] = STRETCH_STEPS,
) -> Float[np.ndarray, "V 3"]:
    """A free surface moved further, any way: for spread fingers, sleeves, what no offset along
    normals reaches.

    The plate is that of the further offset as a vector; where the surface lies on the scan already,
    little moves.
    """
    plate, area = _plate(topology, surface)
    moved = surface
    for step in steps:
        level = _level(topology, surface, moved, cloud)
        held = kron(PLATE * (plate + level), eye_array(3), format="csc")
        found = nearest(topology, moved, cloud.points, cloud.normals)
        weight = _weights(cloud, found, step.reach) * area.sum() / len(cloud.points)
        blocks = (found.barycentric[..., None] * found.normal[:, None]).reshape(-1, 1, 3)
        table = (blocks, topology.faces[found.face].ravel(), np.arange(0, len(blocks) + 1, 3))
        rows = bsr_array(table, shape=(len(cloud.points), 3 * len(surface))).tocsr()
        start = np.einsum("pk,pkc->pc", found.barycentric, surface[topology.faces[found.face]])
        apart = ((cloud.points - start) * found.normal).sum(1)
        moved = surface + _solved(rows, weight, apart, step.stiffness * held).reshape(-1, 3)
    return moved


def _plate(topology: Topology, vertices: np.ndarray) -> tuple[csc_array, Float[np.ndarray, " V"]]:
    """The plate with the term that it needs to have a solution, and the areas of vertices."""
    laplacian, area = cotangent_laplacian(vertices, topology.faces)
    stiff = np.maximum(1.0, FINE**2 / area) / area
    return csc_array(
        laplacian.T @ diags_array(stiff) @ laplacian + diags_array(area / RETURN**4)
    ), area


def _level(
    topology: Topology, vertices: np.ndarray, surface: np.ndarray, cloud: Cloud
) -> csc_array:
    """What levels the offset where there is no scan."""
    unseen = 1.0 - vertex_weights(topology, surface, cloud)[topology.faces].min(1)
    return cotangent_laplacian(vertices, topology.faces, unseen)[0] / LEVEL**2


def _solved(rows: csr_array, weight: np.ndarray, apart: np.ndarray, held: csc_array) -> np.ndarray:
    matrix = csc_array(rows.T @ diags_array(weight) @ rows + held)
    return factored(matrix).solve(rows.T @ (weight * apart))


def factored(matrix: csc_array) -> SuperLU:
    """The factors of a symmetric positive definite matrix, which needs no pivots off its diagonal:
    they fill it.
    """
    return splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def _weights(cloud: Cloud, found: Nearest, reach: float) -> Float[np.ndarray, " P"]:
    distance = np.linalg.norm(cloud.points - found.place, axis=1)
    return geman_mcclure_weight(distance, reach) * (found.cosine > LEAST_COSINE)


def _creased(energy: csc_array, normal: Float[np.ndarray, "V 3"]) -> csc_array:
    """The matrix of E(h) + b E(h n) from that of E(h)."""
    table = coo_array(energy)
    row, column = table.coords
    alike = np.einsum("ec,ec->e", normal[row], normal[column])
    return csc_array(
        coo_array((table.data * (1.0 + CREASE * alike), (row, column)), shape=energy.shape)
    )


def _pulls(
    topology: Topology, model: np.ndarray, normal: np.ndarray, cloud: Cloud, found: Nearest
) -> tuple[csr_array, Float[np.ndarray, " P"]]:
    """Rows (P, V) of n_p . x(b_p) by h, and what they should be beyond the model's."""
    corners = topology.faces[found.face]
    along = found.barycentric * np.einsum("pkc,pc->pk", normal[corners], found.normal)
    ends = np.arange(0, 3 * len(corners) + 1, 3)
    rows = csr_array((along.ravel(), corners.ravel(), ends), shape=(len(corners), len(model)))
    start = np.einsum("pk,pkc->pc", found.barycentric, model[corners])
    return rows, ((cloud.points - start) * found.normal).sum(1)


BACK = 0.7
"""How much of an offset is left, each time, where the surface cuts itself."""
RINGS = 1
"""Vertices around these go back with them, half as far."""
ROUNDS = 20


def new_cuts(
    topology: Topology, model: Float[np.ndarray, "V 3"], surface: Float[np.ndarray, "V 3"]
) -> int:
    """How many more pairs of triangles cut each other in a surface (m) than in its model."""
    faces = topology.faces[np.isin(topology.faces, topology.whole).all(1)]
    return max(0, len(intersecting_pairs(surface, faces)) - len(intersecting_pairs(model, faces)))


def uncut(
    topology: Topology, model: Float[np.ndarray, "V 3"], surface: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """The surface (m), drawn back towards its model around pairs of triangles that cut each other
    in it alone.
    """
    faces = topology.faces[np.isin(topology.faces, topology.whole).all(1)]
    before = _keys(intersecting_pairs(model, faces), len(faces))
    offset = surface - model
    for _ in range(ROUNDS):
        pairs = intersecting_pairs(model + offset, faces)
        new = pairs[~np.isin(_keys(pairs, len(faces)), before)]
        if len(new) == 0:
            break
        near = _around(topology.faces, np.unique(faces[new]), len(model))
        offset = offset * (1.0 - (1.0 - BACK) * near)[:, None]
    return model + offset


def _keys(pairs: Int[np.ndarray, "K 2"], count: int) -> Int[np.ndarray, " K"]:
    return pairs[:, 0] * count + pairs[:, 1]


def _around(
    faces: Int[np.ndarray, "F 3"], vertices: Int[np.ndarray, " n"], count: int
) -> Float[np.ndarray, " V"]:
    """1 at some vertices and less from ring to ring around them, 0 further off."""
    near = np.zeros(count)
    near[vertices] = 1.0
    for k in range(RINGS):
        ring = np.unique(faces[(near[faces] > 0.0).any(1)])
        near[ring] = np.maximum(near[ring], 1.0 - (k + 1.0) / (RINGS + 1.0))
    return near
