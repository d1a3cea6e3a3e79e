"""Which triangle of a surface is closest to a point, also where several are: rounding must not
choose.
"""

import numpy as np
from jaxtyping import Float, Int

SAME = 1e-6
"""Metres: triangles whose distances from a point differ by less are equally close."""


def closest_faces(
    points: Float[np.ndarray, "M 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
) -> Int[np.ndarray, " M"]:
    """The face closest to each point; of equally close ones the first in the mesh.

    A point above an edge or a corner is equally far from all faces that meet there. Faces without
    area are passed over as long as there are others.
    """
    return closest_points(points, vertices, faces, SAME)[0]


def closest_points(
    points: Float[np.ndarray, "M 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    same: float = 0.0,
) -> tuple[Int[np.ndarray, " M"], Float[np.ndarray, "M 3"]]:
    """The closest face to each point and the place on it that is closest; faces that differ by up
    to ``same`` metres count as equally close.
    """
    from habitus.mesh.closest_kernels import find_closest

    given = (np.ascontiguousarray(each, dtype=np.float64) for each in (points, vertices))
    found = np.empty(len(points), dtype=np.int64)
    closest = np.empty((len(points), 3))
    find_closest(*given, np.ascontiguousarray(faces, dtype=np.int64), float(same), found, closest)
    return found, closest
