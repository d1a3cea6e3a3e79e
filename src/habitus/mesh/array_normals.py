"""Normals of triangles and vertices in array operations, NumPy's or torch's; `normals` is what to
call.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import cross, flatten, is_tensor, namespace, take, to_numpy, unbind
from habitus.types import Array


def face_normals(
    vertices: Float[Array, "*batch V 3"], faces: Int[Array, "T 3"]
) -> Float[Array, "*batch T 3"]:
    """Normals of triangles, twice as long as their area (m^2), to the side from where they run
    counter-clockwise.
    """
    a, b, c = (take(vertices, corner, -2) for corner in unbind(as_index(faces, vertices)))
    return cross(b - a, c - a)


def unit_sums(
    vertices: Float[Array, "*batch V 3"],
    faces: Int[Array, "T 3"],
    which: Int[np.ndarray, " N"] | None = None,
) -> Float[Array, "*batch N 3"]:
    """`vertex_normals` in array operations: the reference of `normal_kernels`."""
    xp = namespace(vertices)
    if which is not None:
        chosen = np.zeros(vertices.shape[-2], dtype=bool)
        chosen[which] = True
        numbers = to_numpy(faces)
        faces = numbers[chosen[numbers].any(1)]
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
