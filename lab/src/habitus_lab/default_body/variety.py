"""How people differ beyond what sliders can say: smooth random offsets of the skin along its
normals, left and right alike.

They go into the further shapes only, so that these can follow people whom no slider makes. Hands,
feet and head keep their form, where a centimetre is a lot.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .elastic import half_edges
from .rig import JOINTS
from .shape_space import vertex_areas

SPREAD = 0.0015  # metres, standard deviation of an offset
LENGTH = 0.08  # metres over which offsets change
KEPT = ("head", "neck", "jaw", "eye", "ankle", "foot", "wrist", *("index", "middle", "pinky"))
KEPT += ("ring", "thumb")


def smooth_offsets(
    mean: np.ndarray,
    faces: np.ndarray,
    mirror: np.ndarray,
    weights: np.ndarray,
    count: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Offsets (N,V,3) float32 of a mean body's (V,3) vertices; weights (V, 55) of the joints."""
    edges, stiffness = half_edges(mean, faces)
    size = len(mean)
    laplacian = sparse.coo_matrix((-stiffness, tuple(edges.T)), (size, size)).tocsr()
    laplacian = laplacian - sparse.diags(np.asarray(laplacian.sum(1)).ravel())
    mass = sparse.diags(np.maximum(vertex_areas(mean, faces), 1e-9))
    solve = splu((mass + LENGTH**2 / 4 * laplacian).tocsc()).solve
    field = mass.sqrt() @ rng.normal(size=(size, count))
    field = solve(mass @ solve(field))
    field = field + field[mirror]
    field /= np.sqrt((field**2).mean(1, keepdims=True)) + 1e-12
    moved = [name.removeprefix("left_").removeprefix("right_") for name in JOINTS]
    free = weights[:, [not name.startswith(KEPT) for name in moved]].sum(1)
    offsets = (SPREAD * free)[:, None] * field
    normals = _normals(mean, faces)
    return (offsets.T[:, :, None] * normals).astype(np.float32)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    normals = np.stack(
        [np.bincount(faces.ravel(), np.repeat(across[:, k], 3), len(vertices)) for k in range(3)], 1
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
