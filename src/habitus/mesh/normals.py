"""Normals of triangles and vertices."""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from habitus.arrays import cross, flatten, is_tensor, namespace, take, to_numpy, unbind
from habitus.rotations import cross_matrix
from habitus.types import Array

TINY = 1e-12


def face_normals(
    vertices: Float[Array, "*batch V 3"], faces: Int[Array, "T 3"]
) -> Float[Array, "*batch T 3"]:
    """Normals of triangles, twice as long as their area (m^2), to the side from where they run
    counter-clockwise.
    """
    a, b, c = (take(vertices, corner, -2) for corner in unbind(as_index(faces, vertices)))
    return cross(b - a, c - a)


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


def unit_sums(
    vertices: Float[Array, "*batch V 3"],
    faces: Int[Array, "T 3"],
    which: Int[np.ndarray, " N"] | None = None,
) -> Float[Array, "*batch N 3"]:
    """`vertex_normals` in array operations: the reference of `normal_kernels`."""
    xp = namespace(vertices)
    if which is not None:
        wanted = np.zeros(vertices.shape[-2], dtype=bool)
        wanted[which] = True
        numbers = to_numpy(faces)
        faces = numbers[wanted[numbers].any(1)]
    total = summed_at_corners(face_normals(vertices, faces), faces, vertices)
    total = total if which is None else total[..., which, :]
    squared = (total * total).sum(-1)[..., None]
    seen = squared > xp.finfo(vertices.dtype).tiny
    return total * seen / xp.sqrt(xp.where(seen, squared, 1.0))


def as_index(faces: Array, like: Array) -> Array:
    """Faces in the library, and on the device, of other numbers."""
    return namespace(like).asarray(faces, device=like.device)


def summed_at_corners(values: Array, faces: Array, like: Array) -> Array:
    """What the triangles (*batch, T, 3) bring to each vertex, summed: in the shape of ``like``."""
    if is_tensor(like):
        total = like.new_zeros(like.shape)
        for corner in unbind(as_index(faces, like)):
            total = total.index_add(-2, corner, values)
        return total
    surfaces = flatten(values[None], 0, -3)
    corners = faces.T.ravel()
    count = like.shape[-2]
    sums = [
        [np.bincount(corners, np.tile(axis, 3), count) for axis in surface.T]
        for surface in surfaces
    ]
    return np.asarray(sums, like.dtype).reshape(-1, 3, count).swapaxes(1, 2).reshape(like.shape)


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
