"""A grid of nodes on a mesh's triangles without seams: a texture's values, places and slopes.

Each triangle is cut into n² alike; neighbouring triangles share the nodes of their edge. Values are
linear on each piece.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array, diags_array


@dataclass(frozen=True, eq=False)
class SkinGrid:
    """G nodes on the faces (F, 3) of a mesh, ``n`` pieces an edge; neighbouring faces share the
    nodes of their edge.

    ``node`` (F, n + 1, n + 1) are those of a face by how far they are to its second and third
    corner; -1 beyond it. ``spread`` (G, G) takes a value at each node to the mean of its
    neighbours', row sums 1.
    """

    n: int
    faces: Int[np.ndarray, "F 3"]
    node: Int[np.ndarray, "F n1 n1"]
    spread: csr_array

    @staticmethod
    def of(faces: Int[np.ndarray, "F 3"], n: int) -> "SkinGrid":
        """To be made once a mesh and fineness."""
        place = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)])
        weights = np.column_stack([n - place.sum(1), place])  # (L, 3), whole numbers of n
        names = np.where(
            weights > 0, (faces[:, None] + 1) * (n + 1) + weights, 0
        )  # the same from all faces it is on
        names.sort(axis=-1)
        base = (int(faces.max()) + 2) * (n + 1)
        _, number = np.unique(
            (names[..., 0] * base + names[..., 1]) * base + names[..., 2], return_inverse=True
        )
        node = np.full((len(faces), n + 1, n + 1), -1)
        node[:, place[:, 0], place[:, 1]] = number.reshape(len(faces), -1)
        return SkinGrid(n, faces, node, _neighbour_means(node))

    @property
    def size(self) -> int:
        """G."""
        return self.spread.shape[0]  # pyright: ignore[reportOptionalSubscript]  (SciPy has no annotations)

    def placed(self, corners: Float[np.ndarray, "V C"]) -> Float[np.ndarray, "G C"]:
        """What the mesh's vertices have (their places), at the nodes, straight in between."""
        out = np.empty((self.size, corners.shape[1]))
        for i in range(self.n + 1):
            for j in range(self.n + 1 - i):
                share = np.array([self.n - i - j, i, j]) / self.n
                out[self.node[:, i, j]] = np.einsum("k,fkc->fc", share, corners[self.faces])
        return out

    @property
    def triangles(self) -> Int[np.ndarray, "T 3"]:
        """The pieces, n² of each face, as triangles of nodes."""
        node = self.node
        lie = np.stack([node[:, :-1, :-1], node[:, 1:, :-1], node[:, :-1, 1:]], -1).reshape(-1, 3)
        turned = np.stack([node[:, 1:, 1:], node[:, :-1, 1:], node[:, 1:, :-1]], -1).reshape(-1, 3)
        every = np.concatenate([lie, turned])
        return every[(every >= 0).all(1)]

    def smoothed(self, values: Float[np.ndarray, "G C"], times: int) -> Float[np.ndarray, "G C"]:
        """Each value's mean with that of its neighbours', so many times."""
        for _ in range(times):
            values = 0.5 * (values + self.spread @ values)
        return values

    def weights(self, face: Int[np.ndarray, " N"], share: Float[np.ndarray, "N 3"]) -> csr_array:
        """Places on faces, by the weights of their corners, from nodes: (N, G), straight in
        between.
        """
        node, weight, _ = self._pieces(face, share)
        ends = np.arange(0, 3 * len(face) + 1, 3)
        return csr_array((weight.ravel(), node.ravel(), ends), shape=(len(face), self.size))

    def slopes(
        self,
        values: Float[np.ndarray, "G C"],
        vertices: Float[np.ndarray, "V 3"],
        face: Int[np.ndarray, " N"],
        share: Float[np.ndarray, "N 3"],
    ) -> Float[np.ndarray, "N C 3"]:
        """How values change along the surface with ``vertices`` (m) at places on it, per metre."""
        node, _, sign = self._pieces(face, share)
        corner = values[node]  # N 3 C
        by_second, by_third = (
            self.n * sign[:, None] * (corner[:, k] - corner[:, 0]) for k in (1, 2)
        )
        a, b, c = vertices[self.faces[face]].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        square = np.maximum((normal**2).sum(1, keepdims=True), 1e-20)
        second = np.cross(c - a, normal) / square
        third = np.cross(normal, b - a) / square
        return by_second[..., None] * second[:, None] + by_third[..., None] * third[:, None]

    def _pieces(
        self, face: np.ndarray, share: np.ndarray
    ) -> tuple[Int[np.ndarray, "N 3"], Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """The nodes around places, their weights, and 1 in pieces that lie as the face does, -1 in
        those between.
        """
        u, v = (self.n * np.clip(share[:, 1:], 0.0, 1.0)).T
        beyond = np.maximum(u + v, self.n) / self.n
        u = u / beyond
        v = v / beyond
        i = np.minimum(u.astype(int), self.n - 1)
        j = np.minimum(v.astype(int), self.n - 1 - i)
        u = u - i
        v = v - j
        other = (u + v > 1.0) & (i + j < self.n - 1)
        k = other.astype(int)
        rows = [(i + k, j + k), (i + 1 - k, j + k), (i + k, j + 1 - k)]
        # turned pieces begin at (1, 1); their second node lies at u = 0, their third at v = 0
        node = np.stack([self.node[face, a, b] for a, b in rows], 1)
        u = np.where(other, 1.0 - u, u)
        v = np.where(other, 1.0 - v, v)
        return node, np.stack([1.0 - u - v, u, v], 1), np.where(other, -1.0, 1.0)


def _neighbour_means(node: np.ndarray) -> csr_array:
    """Neighbours along the three directions of all faces; those of edges are counted once."""
    ends = [
        (node[:, :-1], node[:, 1:]),
        (node[:, :, :-1], node[:, :, 1:]),
        (node[:, 1:, :-1], node[:, :-1, 1:]),
    ]
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in ends])
    pairs = pairs[(pairs >= 0).all(1)]
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    size = int(node.max()) + 1
    near = coo_array((np.ones(len(rows)), (rows, columns)), shape=(size, size)).tocsr()
    near.data[:] = 1.0
    return csr_array(diags_array(1.0 / np.maximum(near.sum(1), 1.0)) @ near)
