"""Normals of triangles and vertices."""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from habitus.arrays import is_tensor
from habitus.mesh.array_normals import as_index, face_normals, unit_sums
from habitus.rotations import cross_matrix
from habitus.types import Array

__all__ = ["face_normals", "vertex_normals"]


def vertex_normals(
    vertices: Float[Array, "*batch V 3"],
    faces: Int[Array, "T 3"],
    which: Int[np.ndarray, " N"] | None = None,
) -> Float[Array, "*batch N 3"]:
    """Unit normals of vertices, or of those numbered ``which``: the mean of the triangles around,
    weighted by area.

    A vertex without triangles, or whose triangles cancel out, gets a zero; its gradient is finite.
    """
    if which is None and is_tensor(vertices):
        from habitus.mesh import compiled_normals

        corners = as_index(faces, vertices)
        if compiled_normals.is_compiled(vertices, corners):
            return compiled_normals.vertex_normals(vertices, corners)
    return unit_sums(vertices, faces, which)


TINY = 1e-12


def normal_jacobian(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> sparse.csr_array:
    """The derivative of `habitus.mesh.normals.vertex_normals` (1/m), (3 V, 3 V), sparse; rows and
    columns x, y, z of vertex after vertex. Zero for a vertex without triangles.

    Of a triangle a b c with n = (b - a) x (c - a), dn/da = [c - b]x, and so on around; the unit
    normal of a sum s of such turns by (1 - n n^T) ds / |s|.
    """
    corners = vertices[faces]
    blocks = cross_matrix(
        corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    )  # of each triangle's normal to its corners
    to = np.repeat(faces, 3, axis=1)
    by = np.tile(faces, 3)
    entries = np.tile(blocks, (1, 3, 1, 1)).reshape(-1, 3, 3)
    count = len(vertices)
    axis = np.arange(3)
    shape = entries.shape
    rows = np.broadcast_to(3 * to.ravel()[:, None, None] + axis[:, None], shape).ravel()
    columns = np.broadcast_to(3 * by.ravel()[:, None, None] + axis, shape).ravel()
    summed = sparse.csr_array((entries.ravel(), (rows, columns)), (3 * count, 3 * count))
    unit = vertex_normals(vertices, faces)
    total = np.zeros((count, 3))
    for corner in faces.T:
        np.add.at(total, corner, face_normals(vertices, faces))
    length = np.linalg.norm(total, axis=1).clip(TINY)
    across = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / length[:, None, None]
    turning = sparse.bsr_array(
        (across, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
    )
    return sparse.csr_array(turning @ summed)
