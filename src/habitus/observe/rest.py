"""The rest surface as a function of betas alone: a view of a body for the shape stage."""

import numpy as np

from habitus.arrays import to_numpy
from habitus.body.model import BodyModel
from habitus.mesh.normals import vertex_normals


class RestShape:
    """A body's rest surface as a function of betas, in float64 NumPy; metres, body space, zero pose."""

    def __init__(self, body: BodyModel) -> None:
        self.template, self.shapedirs = to_numpy(body.v_template, np.float64), to_numpy(body.shapedirs, np.float64)
        self.faces = to_numpy(body.faces, np.int64)

    @property
    def num_betas(self) -> int:
        """B."""
        return self.shapedirs.shape[2]

    def vertices(self, betas: np.ndarray) -> np.ndarray:
        """(V, 3) rest vertices."""
        return self.template + self.shapedirs @ betas

    def normals(self, vertices: np.ndarray, which: np.ndarray) -> np.ndarray:
        """(len(which), 3) area-weighted unit normals of some vertices."""
        return vertex_normals(vertices, self.faces, which)

    def default_markers(
        self, betas: np.ndarray, which: np.ndarray, distance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`habitus.observe.markers.default_markers`: places (M, 3) and derivative (M, 3, B), normals held."""
        vertices = self.vertices(betas)
        return vertices[which] + distance[:, None] * self.normals(vertices, which), self.shapedirs[which]
