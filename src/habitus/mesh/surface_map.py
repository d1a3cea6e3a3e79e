"""Vertices of another mesh as places on a surface: what carries bodies between topologies.

Vertex k of the other mesh lies on triangle ``face[k]`` at ``barycentric[k]``, whatever the shape
and pose of the surface: a linear map that rigid motions and scales pass through.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from habitus.errors import HabitusError


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Where the N vertices of a mesh called ``name`` lie on a surface of V vertices.

    ``corners`` (N, 3) are the vertices of the triangles ``face`` (N,) that they lie on,
    ``barycentric`` (N, 3) sum to one. ``matched`` (N,) is False where the two surfaces have no part
    in common (the inside of a mouth): such vertices lie on the nearest place and tell nothing.
    ``faces`` (F, 3) are the mesh's own triangles.
    """

    name: str
    face: Int[np.ndarray, " N"]
    corners: Int[np.ndarray, "N 3"]
    barycentric: Float[np.ndarray, "N 3"]
    matched: Bool[np.ndarray, " N"]
    faces: Int[np.ndarray, "F 3"]
    surface_vertices: int

    @property
    def num_vertices(self) -> int:
        """N."""
        return len(self.corners)

    def vertices(self, surface: Float[np.ndarray, "*batch V 3"]) -> Float[np.ndarray, "*batch N 3"]:
        """The mesh's vertices on surfaces, in their unit and frame. Raises HabitusError for another
        number of vertices.
        """
        surface = np.asarray(surface, np.float64)
        if surface.shape[-2] != self.surface_vertices:
            raise HabitusError(
                f"a surface of {surface.shape[-2]} vertices; the map to {self.name} expects "
                f"{self.surface_vertices}, the full detail of a bundled body"
            )
        return np.einsum("...nkc,nk->...nc", surface[..., self.corners, :], self.barycentric)

    def matrix(self) -> csr_array:
        """The map as a sparse matrix (N, V): ``matrix() @ surface`` are the vertices."""
        rows = np.repeat(np.arange(self.num_vertices), 3)
        table = (self.barycentric.ravel(), (rows, self.corners.ravel()))
        return csr_array(table, shape=(self.num_vertices, self.surface_vertices))
