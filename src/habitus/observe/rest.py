"""The rest surface as arrays: where a layout places markers on it (MoSh eq. 1)."""

import numpy as np

from habitus.body.model import BodyModel


class RestShape:
    """A body's rest surface as a function of betas, in float64 NumPy; metres, body space, zero pose."""

    def __init__(self, body: BodyModel) -> None:
        self.template = body.v_template.detach().cpu().numpy().astype(np.float64)
        self.shapedirs = body.shapedirs.detach().cpu().numpy().astype(np.float64)
        self._last: tuple[bytes, np.ndarray] = (b"", self.template)
        self.faces = np.ascontiguousarray(body.faces.detach().cpu().numpy(), dtype=np.int64)

    @property
    def num_betas(self) -> int:
        """B."""
        return self.shapedirs.shape[2]

    def vertices(self, betas: np.ndarray) -> np.ndarray:
        """(V, 3) rest vertices; those of the betas last asked for are kept."""
        key = np.asarray(betas, dtype=float).tobytes()
        if key != self._last[0]:
            self._last = (key, self.template + self.shapedirs @ betas)
        return self._last[1]

    def normals(self, vertices: np.ndarray, which: np.ndarray) -> np.ndarray:
        """(len(which), 3) area-weighted unit normals of some vertices."""
        marked = np.zeros(len(vertices), dtype=bool)
        marked[which] = True
        ring = self.faces[marked[self.faces].any(axis=1)]
        a, b, c = np.swapaxes(vertices[ring], 0, 1)
        normal = np.cross(b - a, c - a)
        total = np.zeros_like(vertices)
        for corner in range(3):
            np.add.at(total, ring[:, corner], normal)
        return total[which] / (np.linalg.norm(total[which], axis=1, keepdims=True) + 1e-300)

    def default_markers(
        self, betas: np.ndarray, which: np.ndarray, distance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """v_i(betas) = S_h(i) + d_i N_h(i) (eq. 1): places (M, 3) and derivative (M, 3, B), normals held."""
        vertices = self.vertices(betas)
        return vertices[which] + distance[:, None] * self.normals(vertices, which), self.shapedirs[which]
