"""Where a triangle mesh cuts itself, and triangles that are turned over: a fast count for many
bodies of one mesh.
"""

from __future__ import annotations

import numpy as np

from habitus.mesh.intersections import intersecting_pairs

__all__ = ["intersecting_pairs", "turned_over"]


def turned_over(vertices: np.ndarray, faces: np.ndarray, template: np.ndarray) -> np.ndarray:
    """(F,) True for triangles whose normal points more than a right angle away from the
    template's.
    """

    def normals(points: np.ndarray) -> np.ndarray:
        a = points[faces[:, 0]]
        b = points[faces[:, 1]]
        c = points[faces[:, 2]]
        return np.cross(b - a, c - a)

    return (normals(vertices) * normals(template)).sum(1) <= 0
