"""A cage of tetrahedra around flesh: points in it, and numbers spread over it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from habitus.errors import HabitusError

NEIGHBOURS = 24
"""Tetrahedra by nearest centre that are tried for a point."""


@dataclass(frozen=True)
class Embedding:
    """Points in tetrahedra: the four nodes of each, and their weights, which sum to one."""

    corners: Int[np.ndarray, "P 4"]
    weights: Float[np.ndarray, "P 4"]

    def __call__(self, values: Float[np.ndarray, "N ..."]) -> Float[np.ndarray, "P ..."]:
        """Values at the points from those at the nodes."""
        return np.einsum("pa,pa...->p...", self.weights, values[self.corners])

    def matrix(self, nodes: int) -> sparse.csr_matrix:
        """(P, N) the same, sparse."""
        rows = np.repeat(np.arange(len(self.corners)), 4)
        return sparse.csr_matrix(
            (self.weights.ravel(), (rows, self.corners.ravel())), shape=(len(self.corners), nodes)
        )

    def of(self, some: np.ndarray) -> "Embedding":
        """Those of some points."""
        return Embedding(self.corners[some], self.weights[some])


@dataclass(frozen=True, eq=False)
class Cage:
    """Tetrahedra of positive volume over nodes (m)."""

    nodes: Float[np.ndarray, "N 3"]
    tets: Int[np.ndarray, "T 4"]

    def __post_init__(self):
        if (self.volumes <= 0).any():
            count = int((self.volumes <= 0).sum())
            tets = len(self.tets)
            raise HabitusError(
                f"{count} of the cage's {tets} tetrahedra are flat or inverted; mesh it anew"
            )

    @cached_property
    def edges(self) -> Float[np.ndarray, "T 3 3"]:
        """Columns: the edges from the first corner."""
        corners = self.nodes[self.tets]
        return (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2)

    @cached_property
    def volumes(self) -> Float[np.ndarray, " T"]:
        """Signed, m^3."""
        return np.linalg.det(self.edges) / 6

    @cached_property
    def centres(self) -> Float[np.ndarray, "T 3"]:
        """Means of the corners."""
        return self.nodes[self.tets].mean(1)

    @cached_property
    def gradients(self) -> Float[np.ndarray, "T 4 3"]:
        """Gradients of the corners' hat functions."""
        inverse = np.linalg.inv(self.edges)
        return np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)

    @cached_property
    def laplacian(self) -> sparse.csc_matrix:
        """(N, N) positive semi-definite, m."""
        local = np.einsum("t,tac,tbc->tab", self.volumes, self.gradients, self.gradients)
        rows = np.repeat(self.tets, 4, 1)
        columns = np.tile(self.tets, (1, 4))
        n = len(self.nodes)
        return sparse.csc_matrix((local.ravel(), (rows.ravel(), columns.ravel())), shape=(n, n))

    def embed(self, points: Float[np.ndarray, "P 3"]) -> tuple[Embedding, Int[np.ndarray, " P"]]:
        """Points in the tetrahedra that hold them, or stick out of them the least, and which these
        are.
        """
        tree = KDTree(self.centres)
        _, near = tree.query(points, k=min(NEIGHBOURS, len(self.tets)))
        inverse = np.linalg.inv(self.edges)
        local = np.einsum(
            "pkij,pkj->pki", inverse[near], points[:, None] - self.nodes[self.tets[near, 0]]
        )
        weights = np.concatenate([1 - local.sum(-1, keepdims=True), local], -1)
        best = weights.min(-1).argmax(1)
        rows = np.arange(len(points))
        tets = near[rows, best]
        return Embedding(self.tets[tets], np.ascontiguousarray(weights[rows, best])), tets

    def smooth(self, points: Embedding, places: Float[np.ndarray, "P 3"]) -> sparse.csr_matrix:
        """(P, N) that carries points at rest `places` with the nodes, exactly where these move by
        quadratic functions.

        Barycentric weights alone show every face of the cage as a facet. Here each node adds half
        of what its mean gradient of deformation says of the way from it to the point (errors of
        second order cancel).
        """
        n = len(self.nodes)
        v = len(points.corners)
        shares = (
            self.volumes[:, None]
            / np.bincount(self.tets.ravel(), np.repeat(self.volumes, 4), n)[self.tets]
        )
        rows = np.repeat(self.tets, 4, 1).ravel()
        columns = np.tile(self.tets, (1, 4)).ravel()
        off = points.weights[:, :, None] * (places[:, None] - self.nodes[points.corners])
        total = points.matrix(n)
        for c in range(3):
            slopes = shares[:, :, None] * self.gradients[:, None, :, c]
            gradient = sparse.csr_matrix((slopes.ravel(), (rows, columns)), shape=(n, n))
            way = sparse.csr_matrix(
                (off[:, :, c].ravel(), (np.repeat(np.arange(v), 4), points.corners.ravel())), (v, n)
            )
            total = total + 0.5 * way @ gradient
        return total.tocsr()

    def spread(
        self, points: Embedding, values: Float[np.ndarray, "P K"], firm: float
    ) -> Float[np.ndarray, "N K"]:
        """Smooth values at the nodes (harmonic) that are about those given at points; `firm` weighs
        a point.
        """
        onto = points.matrix(len(self.nodes))
        left = (self.laplacian + firm * onto.T @ onto).tocsc()
        return splu(left).solve(np.ascontiguousarray(firm * (onto.T @ values)))

    def reordered(self) -> "Cage":
        """Nodes in an order that keeps neighbours close in memory."""
        order = reverse_cuthill_mckee(sparse.csr_matrix(self.laplacian), symmetric_mode=True)
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order))
        tets = place[self.tets]
        return Cage(self.nodes[order], tets[np.argsort(tets.min(1), kind="stable")])

    def at(self, nodes: Float[np.ndarray, "N 3"]) -> "Cage":
        """The same tetrahedra elsewhere. Raises HabitusError where one is inverted."""
        return replace(self, nodes=nodes)


def positive_cage(nodes: Float[np.ndarray, "N 3"], tets: Int[np.ndarray, "T 4"]) -> Cage:
    """A cage from tetrahedra of either orientation; nodes that none uses go."""
    used, index = np.unique(tets, return_inverse=True)
    tets = index.reshape(-1, 4)
    nodes = np.asarray(nodes, float)[used]
    corners = nodes[tets]
    turned = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    return Cage(nodes, tets).reordered()
