"""Normals of triangles and vertices."""

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import is_tensor
from habitus.mesh.array_normals import as_index, face_normals, unit_sums
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
