"""Elbows that keep their shape when the arm is straightened: as-rigid-as-possible refinement of the
T-pose.

Linear blend skinning shrinks what lies between two bones. Vertices that follow one bone stay where
skinning put them; those between find the places in which their neighbourhoods are turned, not
stretched (Sorkine, Alexa 2007), measured against the A-pose. The left side is solved and the right
one mirrored. Shoulders are left to skinning: without a bone inside, a surface that is only rigid
folds on top of them.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import factorized

BLENDED = 0.97  # a vertex whose largest segment weight is below this lies between bones
GROW = 2  # rings of neighbours added to the free region
ITERATIONS = 15
SEGMENT = "left_forearm_upper"  # the elbow is straightened by 45 degrees
PARENT = "left_upper_arm"


class Elastic:
    """As-rigid-as-possible solver over the free region, factored once for one mesh."""

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        weights: dict[str, np.ndarray],
        mirror: np.ndarray,
    ):
        """rest (V,3): an average body in the A-pose, its edge weights serve everybody; weights:
        segment -> (V,).
        """
        edges, stiffness = half_edges(rest, faces)
        free = _free_region(rest, edges, weights, mirror)
        self.mirror = mirror
        near = np.isin(edges[:, 0], free) | np.isin(edges[:, 1], free)
        self.local, index = np.unique(
            edges[near], return_inverse=True
        )  # the free vertices and their neighbours
        self.edges = index.reshape(-1, 2)
        self.stiffness = stiffness[near]
        self.free = np.flatnonzero(np.isin(self.local, free))
        count = len(self.local)
        laplacian = sparse.coo_matrix(
            (-self.stiffness, tuple(self.edges.T)), (count, count)
        ).tocsr()
        laplacian = laplacian - sparse.diags(np.asarray(laplacian.sum(1)).ravel())
        self.outer = laplacian[self.free]
        self.solve = factorized(self.outer[:, self.free].tocsc())
        self.gather = sparse.coo_matrix(
            (np.ones(near.sum()), (self.edges[:, 0], np.arange(near.sum()))), (count, near.sum())
        ).tocsr()

    def refine(self, rest: np.ndarray, posed: np.ndarray) -> np.ndarray:
        """Vertices (V,3): `posed` with its left free region, and the mirrored right one, as rigid
        as possible to `rest`.
        """
        a, b = self.edges.T
        spokes = rest[self.local][a] - rest[self.local][b]
        now = posed[self.local]
        held = now.copy()
        held[self.free] = 0
        pull = self.outer @ held
        for _ in range(ITERATIONS):
            turn = self._rotations(spokes, now[a] - now[b])
            wanted = (
                0.5 * self.stiffness[:, None] * np.einsum("eij,ej->ei", turn[a] + turn[b], spokes)
            )
            goal = (self.gather @ wanted)[self.free] - pull
            now[self.free] = np.stack([self.solve(goal[:, k]) for k in range(3)], 1)
        refined = posed.copy()
        left = self.local[self.free]
        refined[left] = now[self.free]
        refined[self.mirror[left]] = now[self.free] * [-1, 1, 1]
        return refined

    def _rotations(self, spokes: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """(L,3,3) best rotation of every local vertex' spokes."""
        outer = self.stiffness[:, None, None] * moved[:, :, None] * spokes[:, None, :]
        u, _, v = np.linalg.svd((self.gather @ outer.reshape(-1, 9)).reshape(-1, 3, 3))
        u[:, :, 2] *= np.sign(np.linalg.det(u @ v))[:, None]
        return u @ v


def half_edges(rest: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both directions of every edge (E,2) and its cotangent weight (E,), clipped to stay
    positive.
    """
    pairs = []
    values = []
    for k in range(3):
        i = faces[:, k]
        j = faces[:, (k + 1) % 3]
        top = faces[:, (k + 2) % 3]
        u = rest[i] - rest[top]
        v = rest[j] - rest[top]
        cot = 0.5 * (u * v).sum(1) / np.maximum(np.linalg.norm(np.cross(u, v), axis=1), 1e-12)
        pairs += [np.stack([i, j], 1), np.stack([j, i], 1)]
        values += [cot, cot]
    pairs = np.concatenate(pairs)
    values = np.concatenate(values)
    table = sparse.coo_matrix((values, tuple(pairs.T)), (len(rest), len(rest))).tocsr().tocoo()
    return np.stack([table.row, table.col], 1), np.maximum(table.data, 0.05)


def _free_region(
    rest: np.ndarray, edges: np.ndarray, weights: dict[str, np.ndarray], mirror: np.ndarray
) -> np.ndarray:
    """Vertices of the left side between upper arm and forearm, and some rings around them."""
    free = (weights[SEGMENT] > 1 - BLENDED) & (weights[PARENT] > 1 - BLENDED) & (rest[:, 0] > 1e-6)
    for _ in range(GROW):
        touched = np.zeros(len(rest), bool)
        touched[edges[free[edges[:, 0]], 1]] = True
        free |= touched & (rest[:, 0] > 1e-6)
    twin = np.zeros(len(rest), bool)
    twin[mirror[np.flatnonzero(free)]] = True
    return np.flatnonzero(free & ~twin)
