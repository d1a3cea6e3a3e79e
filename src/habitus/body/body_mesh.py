"""What a body's mesh has besides triangles: quads, texture coordinates, and what nobody sees."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """Quads (Q, 4) of vertex numbers, counter-clockwise from outside; ``quad_uv`` of rows of
    ``uv``, from below left.

    ``hidden`` quads line pockets that nobody sees: the inside of the mouth, the sockets of the
    eyes.
    """

    quads: Int[np.ndarray, "Q 4"]
    uv: Float[np.ndarray, "N 2"]
    quad_uv: Int[np.ndarray, "Q 4"]
    hidden: Bool[np.ndarray, " Q"]

    def pockets(self, vertices: Int[np.ndarray, " V"]) -> Bool[np.ndarray, " V"]:
        """Which of these vertices no quad that is seen has."""
        return ~np.isin(vertices, self.quads[~self.hidden])

    def triangle_uv(self, faces: Int[np.ndarray, "T 3"]) -> Int[np.ndarray, "T 3"] | None:
        """Rows of ``uv`` for each corner of triangles that are the quads cut in two, in any order;
        None for others.
        """
        if len(faces) != 2 * len(self.quads):
            return None
        size = int(max(self.quads.max(initial=0), faces.max(initial=0))) + 1
        thirds = numbered(
            np.concatenate([np.delete(self.quads, corner, axis=1) for corner in range(4)]), size
        )
        order = np.argsort(thirds, kind="stable")
        edges = numbered(faces, size)
        place = np.minimum(np.searchsorted(thirds[order], edges), len(thirds) - 1)
        if not np.array_equal(thirds[order][place], edges):
            return None
        quad = order[place] % len(self.quads)
        if (np.bincount(quad, minlength=len(self.quads)) != 2).any():
            return None
        corner = (self.quads[quad][:, None, :] == faces[:, :, None]).argmax(-1)
        return np.take_along_axis(self.quad_uv[quad], corner, 1)


def numbered(triangles: Int[np.ndarray, "T 3"], size: int) -> Int[np.ndarray, " T"]:
    """One number for each set of three of ``size`` vertices, whichever comes first."""
    a, b, c = np.sort(triangles, axis=1).T.astype(np.int64)
    return (a * size + b) * size + c
