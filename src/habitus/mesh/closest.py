"""Which triangle of a surface is closest to a point, also where several are: rounding must not choose."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist

SAME = 1e-6
"""Metres: triangles whose distances from a point differ by less are equally close."""


def closest_faces(
    points: Float[np.ndarray, "M 3"], vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, " M"]:
    """The face closest to each point; of equally close ones the first in the mesh.

    A point above an edge or a corner is equally far from all faces that meet there. Faces without area are passed over
    as long as there are others.
    """
    corners = vertices[faces]
    sides = corners[:, 1:] - corners[:, :1]
    solid = np.flatnonzero(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > 0.0)
    solid = solid if len(solid) else np.arange(len(faces))
    corners = corners[solid]
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    away = cdist(points, middle)  # the nearest middle is further away than the triangle around it
    point, near = np.nonzero(away - reach <= away.min(axis=1, keepdims=True) + SAME)
    distance = _distances(points[point], corners[near])
    first = np.flatnonzero(np.diff(point, prepend=-1))
    least = np.minimum.reduceat(distance, first)
    same = np.flatnonzero(distance <= least[point] + SAME)
    return solid[near[same[np.flatnonzero(np.diff(point[same], prepend=-1))]]]


def _distances(points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, " N"]:
    """Of points, each from its triangle: from the plane where it is above the triangle, from the nearest side else."""
    off, side = points[:, None] - corners, np.roll(corners, -1, axis=1) - corners
    along = np.clip((off * side).sum(2) / np.maximum((side * side).sum(2), 1e-300), 0.0, 1.0)
    from_sides = np.linalg.norm(off - along[..., None] * side, axis=2).min(axis=1)
    normal = np.cross(side[:, 0], side[:, 1])
    above = (np.cross(side, off) * normal[:, None]).sum(2).min(axis=1) > 0.0
    from_plane = np.abs((off[:, 0] * normal).sum(1)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    return np.where(above, from_plane, from_sides)
