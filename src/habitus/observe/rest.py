"""The rest surface as arrays: where a layout places markers on it (MoSh eq. 1)."""

from functools import cached_property

import numpy as np

from habitus.body.model import BodyModel


class RestShape:
    """A body's rest surface as a function of betas, in float64 NumPy; metres, body space, zero pose."""

    def __init__(self, body: BodyModel) -> None:
        self.template = body.v_template.detach().cpu().numpy().astype(np.float64)
        self.shapedirs = body.shapedirs.detach().cpu().numpy().astype(np.float64)
        self.faces = np.ascontiguousarray(body.faces.detach().cpu().numpy(), dtype=np.int64)

    @property
    def num_betas(self) -> int:
        """B."""
        return self.shapedirs.shape[2]

    @cached_property
    def _rings(self) -> dict[int, np.ndarray]:
        rings: dict[int, list[int]] = {}
        for index, face in enumerate(self.faces):
            for vertex in face:
                rings.setdefault(int(vertex), []).append(index)
        return {vertex: np.array(ring) for vertex, ring in rings.items()}

    def vertices(self, betas: np.ndarray) -> np.ndarray:
        """(V, 3) rest vertices."""
        return self.template + self.shapedirs @ betas

    def normals(self, vertices: np.ndarray, which: np.ndarray) -> np.ndarray:
        """(len(which), 3) area-weighted unit normals of some vertices."""
        out = np.empty((len(which), 3))
        for row, vertex in enumerate(which):
            a, b, c = np.swapaxes(vertices[self.faces[self._rings[int(vertex)]]], 0, 1)
            normal = np.cross(b - a, c - a).sum(axis=0)
            out[row] = normal / (np.linalg.norm(normal) + 1e-300)
        return out

    def default_markers(self, betas: np.ndarray, which: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """v_i(betas) = S_h(i) + d_i N_h(i) (eq. 1): places (M, 3) and derivative (M, 3, B), normals held."""
        vertices = self.vertices(betas)
        return vertices[which] + distance[:, None] * self.normals(vertices, which), self.shapedirs[which]
