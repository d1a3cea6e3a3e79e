"""A surface as triangles that are deformed one by one and stitched together again (SCAPE: Anguelov
et al. 2005).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg
from jaxtyping import Float, Int

from habitus.errors import HabitusError


def triangle_frames(
    vertices: Float[np.ndarray, "*batch V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "*batch F 3 3"]:
    """Two columns (m) that stand for each triangle's edges and, so that all of a deformation is
    determined, its normal.

    The first two mix the edges such that squares of differences are summed over all three of them.
    Edges tell only six of a deformation's nine numbers. The normal is as long as the root of twice
    the triangle's area: it grows with the triangle (Sumner and Popović 2004).
    """
    a, b, c = (np.take(vertices, faces[:, k], axis=-2) for k in range(3))
    first = b - a
    second = c - a
    normal = np.cross(first, second)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.sqrt(np.maximum(length, 1e-300))
    return np.stack([(2.0 * first - second) / np.sqrt(2.0), np.sqrt(1.5) * second, normal], -1)


@dataclass(frozen=True, eq=False)
class Stitching:
    """Vertices of a template's triangles after each was deformed by a matrix of its own, by least
    squares of edges.

    All three edges of each triangle count alike. What the edges leave open, the place, is settled
    by the mean of the vertices, which is that of the template. The matrix to be solved is the same
    for all deformations and is factored once; `corners` takes deformations to right-hand sides.
    """

    corners: scipy.sparse.csr_array
    factor: Any
    mean: Float[np.ndarray, " 3"]

    def vertices(self, deformations: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "V 3"]:
        """Stitched vertices (m) of deformed triangles."""
        return self.solve(self.gather(deformations)) + self.mean

    def gather(self, deformations: Float[np.ndarray, "F C 3"]) -> Float[np.ndarray, "V C"]:
        """Right-hand sides: what each triangle's deformed corners add to their vertices, for C rows
        of matrices.
        """
        count = deformations.shape[1]
        return self.corners @ np.ascontiguousarray(deformations.transpose(0, 2, 1)).reshape(
            -1, count
        )

    def solve(self, right: Float[np.ndarray, "V C"]) -> Float[np.ndarray, "V C"]:
        """Vertices' coordinates, their mean at zero, of right-hand sides; one back-substitution for
        all columns.
        """
        free = self.factor.solve(np.ascontiguousarray(right[1:]))
        free = np.concatenate([np.zeros_like(right[:1]), free])
        return free - free.mean(0)


def stitching(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Stitching:
    """The stitching of a template's triangles (m). Raises HabitusError unless it is one connected
    surface.
    """
    count = len(vertices)
    flat = faces.ravel()
    ends = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)
    ones = np.ones(2 * len(ends))
    pairs = np.concatenate([ends, ends[:, ::-1]])
    joined = scipy.sparse.csr_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _check_connected(joined, count)
    laplacian = scipy.sparse.csc_array(scipy.sparse.diags_array(joined.sum(1)) - joined)[1:, 1:]
    options = {"SymmetricMode": True}
    factor = scipy.sparse.linalg.splu(
        laplacian, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    arms = 3.0 * (
        vertices[faces] - vertices[faces].mean(1, keepdims=True)
    )  # a corner's two edges towards it, summed
    columns = (3 * np.arange(len(faces))[:, None, None] + np.arange(3)).repeat(3, 1)
    corners = scipy.sparse.csr_array(
        (arms.ravel(), (flat.repeat(3), columns.ravel())), shape=(count, 3 * len(faces))
    )
    return Stitching(corners, factor, vertices.mean(0))


def _check_connected(joined: scipy.sparse.csr_array, count: int) -> None:
    pieces, _ = scipy.sparse.csgraph.connected_components(joined, directed=False)
    if pieces != 1:
        raise HabitusError(
            f"the template of {count} vertices is in {pieces} pieces; triangles can be stitched "
            "to one connected "
            "surface only: leave eyes, teeth and vertices without triangles out"
        )
