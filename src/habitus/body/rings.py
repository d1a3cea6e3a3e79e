"""Material rings: where a plane cuts a body's template, as fixed places on its edges, and a tape's
length around them.

A ring is found once, on the template. On any other rest surface of the same body it lies at the
same places of the same edges, so that a tape's length changes continuously with the shape: no plane
has to find its loop again, and a loop cannot open. The tape spans hollows: its length is that of
the convex hull of the ring as seen along its axis.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

_DIRECTIONS = 180  # in which a hull's width is taken: right to 5e-5


@dataclass(frozen=True, eq=False)
class Ring:
    """Points on edges of a mesh: ``share`` of the way from the first vertex of ``edges`` to the
    second.

    ``axes`` are two directions across the ring's axis, as wide as unit vectors.
    """

    edges: Int[np.ndarray, "K 2"]
    share: Float[np.ndarray, " K"]
    axes: Float[np.ndarray, "2 3"]

    def points(self, vertices: Float[np.ndarray, "*batch V 3"]) -> Float[np.ndarray, "*batch K 3"]:
        """The ring on a surface."""
        start = vertices[..., self.edges[:, 0], :]
        end = vertices[..., self.edges[:, 1], :]
        return start + self.share[:, None] * (end - start)

    def length(self, vertices: Float[np.ndarray, "*batch V 3"]) -> Any:
        """Of a tape around it: the perimeter of its convex hull (Cauchy: its mean width, times
        pi).
        """
        flat = self.points(vertices) @ self.axes.T
        angle = np.arange(_DIRECTIONS) * (np.pi / _DIRECTIONS)
        width = np.ptp(flat @ np.stack([np.cos(angle), np.sin(angle)]), axis=-2)
        return width.mean(axis=-1) * np.pi

    def extent(
        self, vertices: Float[np.ndarray, "*batch V 3"], direction: Float[np.ndarray, " 3"]
    ) -> Any:
        """How far it reaches along a unit direction, (*batch,)."""
        return np.ptp(self.points(vertices) @ direction, axis=-1)

    def middle(self, vertices: Float[np.ndarray, "V 3"], within: float) -> "Ring | None":
        """Those of its points that lie in the body's plane of symmetry on this surface; None for
        fewer than two.
        """
        near = np.abs(self.points(vertices)[:, 0]) < within
        return Ring(self.edges[near], self.share[near], self.axes) if near.sum() > 1 else None

    def tape(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "H 3"]:
        """The places in order at which a tape around it touches the skin, to be drawn."""
        points = self.points(vertices)
        try:
            return points[ConvexHull(points @ self.axes.T).vertices]
        except QhullError:
            return points


def cut(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "T 3"],
    place: Float[np.ndarray, " 3"],
    normal: Float[np.ndarray, " 3"],
    whole: bool = False,
) -> Ring | None:
    """Where a plane through a place cuts a surface: the loop nearest to the place, or all of them
    (``whole``).
    """
    normal = normal / np.linalg.norm(normal)
    height = (vertices - place) @ normal
    above = height >= 0
    crossing = faces[above[faces].any(1) & ~above[faces].all(1)]
    if len(crossing) == 0:
        return None
    sides = np.sort(np.stack([crossing, np.roll(crossing, -1, axis=1)], -1), -1)
    cuts = above[sides[..., 0]] != above[sides[..., 1]]
    edges, which = np.unique(
        sides[cuts], axis=0, return_inverse=True
    )  # two cut sides a triangle, in order of triangles
    near, far = height[edges].T
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    ring = Ring(edges, near / (near - far), np.stack([first, np.cross(normal, first)]))
    if whole:
        return ring
    links = which.reshape(-1, 2)
    graph = coo_array(
        (np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(edges), len(edges))
    )
    count, loop = connected_components(graph, directed=False)
    points = ring.points(vertices)
    nearest = int(
        np.argmin([np.linalg.norm(points[loop == k].mean(0) - place) for k in range(count)])
    )
    return Ring(edges[loop == nearest], ring.share[loop == nearest], ring.axes)
