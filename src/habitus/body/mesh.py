"""What a body's mesh has besides triangles: the quads they were cut from, a texture's coordinates, hidden pockets."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """Quads (Q, 4) of vertex numbers, counter-clockwise from outside; ``quad_uv`` of rows of ``uv``, from below left.

    ``hidden`` quads line pockets that nobody sees: the inside of the mouth, the sockets of the eyes.
    """

    quads: Int[np.ndarray, "Q 4"]
    uv: Float[np.ndarray, "N 2"]
    quad_uv: Int[np.ndarray, "Q 4"]
    hidden: Bool[np.ndarray, " Q"]

    def triangle_uv(self, faces: Int[np.ndarray, "T 3"]) -> Int[np.ndarray, "T 3"] | None:
        """Rows of ``uv`` for each corner of triangles that are the quads cut in two; None where these are others."""
        if len(faces) != 2 * len(self.quads):
            return None
        size = int(max(self.quads.max(initial=0), faces.max(initial=0))) + 1
        corner = (np.arange(len(self.quads))[:, None] * size + self.quads).ravel()
        order = np.argsort(corner, kind="stable")
        for which in (np.repeat(np.arange(len(self.quads)), 2), np.tile(np.arange(len(self.quads)), 2)):
            wanted = which[:, None] * size + faces
            place = np.minimum(np.searchsorted(corner[order], wanted), len(corner) - 1)
            if np.array_equal(corner[order][place], wanted):
                return self.quad_uv.ravel()[order][place]
        return None
