"""Skin that touches skin, drawn a little apart: blend shapes are never exact, and what touches
would pass through.

Where a vertex has skin of another place before it, nearer than `GAP`, both give way by half of what
is missing, along their own normals; what gives way is spread over the neighbours, so that no dent
has an edge.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

GAP = 0.008  # m: how far apart touching skin is drawn; simulated contact leaves 3 mm
FAR = 0.03  # m at rest: nearer vertices are the same place
FACING = -0.3  # least cosine of normals that face each other, negative
MOST = 0.006  # m a vertex gives way
SPREAD = 3  # rounds of spreading to neighbours


def drawn_apart(
    vertices: np.ndarray,
    rest: np.ndarray,
    faces: np.ndarray,
    neighbours: sparse.csr_matrix,
    gap: float = GAP,
) -> np.ndarray:
    """Vertices (V, 3) of a posed skin, its faces (F, 3), with touching places `gap` apart; rest (V,
    3) is the person.

    `neighbours` (V, V) averages over the vertices next to each, as `averaging` gives it.
    """
    normal = _normals(vertices, faces)
    pairs = KDTree(vertices).query_pairs(gap, output_type="ndarray")
    far = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) > FAR
    pairs = pairs[far & ((normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(1) < FACING)]
    here, there = np.concatenate([pairs, pairs[:, ::-1]]).T
    missing = gap - ((vertices[there] - vertices[here]) * normal[here]).sum(1)
    give = np.zeros(len(vertices))
    np.maximum.at(give, here, np.clip(missing / 2, 0, MOST))
    for _ in range(SPREAD if len(pairs) else 0):
        give = np.maximum(give, neighbours @ give)
    return vertices - give[:, None] * normal


def averaging(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """(V, V) the mean over the vertices that share an edge with each; 0 for vertices of no face."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    share = 1 / np.bincount(ends[:, 0], minlength=count)[ends[:, 0]]
    return sparse.csr_matrix((share, (ends[:, 0], ends[:, 1])), (count, count))


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    turn = np.cross(b - a, c - a)
    found = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(found, faces[:, k], turn)
    return found / np.linalg.norm(found, axis=1, keepdims=True)
