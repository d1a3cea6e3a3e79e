"""Which point of a posed surface a scanned point belongs to: the nearest whose normal looks the
same way.

Where a scan tells of a registered surface, and the surface carried back to rest.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from habitus.body.model import BodyModel
from habitus.fit.points.correspondence_kernels import nearest_around
from habitus.fit.points.scan import Cloud
from habitus.mesh.normals import face_normals, vertex_normals

TURN = 0.06
"""Metres: how far apart two places count whose normals are 60 degrees apart, in choosing the
nearest.
"""


@dataclass(frozen=True, eq=False)
class Nearest:
    """Of N points the face (N,), the weights of its corners (N, 3), the place (N, 3), the face's
    normal (N, 3), and the cosine (N,) of that with the point's own normal.
    """

    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]
    place: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    cosine: Float[np.ndarray, " N"]


@dataclass(frozen=True, eq=False)
class Topology:
    """The faces of a mesh of V vertices, and those around each vertex: ``around[start[i] : start[i
    + 1]]``.

    ``whole`` are vertices that points may belong to: all but those of pockets that nobody sees.
    """

    faces: Int[np.ndarray, "F 3"]
    start: Int[np.ndarray, " V1"]
    around: Int[np.ndarray, " K"]
    whole: Int[np.ndarray, " W"]

    @staticmethod
    def of(
        faces: Int[np.ndarray, "F 3"], vertices: int, hidden: Bool[np.ndarray, " V"] | None = None
    ) -> "Topology":
        """The topology of a mesh; ``hidden`` vertices are left out."""
        order = np.argsort(faces.ravel(), kind="stable")
        start = np.searchsorted(faces.ravel()[order], np.arange(vertices + 1))
        seen = np.arange(vertices) if hidden is None else np.flatnonzero(~hidden)
        used = np.zeros(vertices, dtype=bool)
        used[faces] = True
        return Topology(np.ascontiguousarray(faces), start, order // 3, seen[used[seen]])


def nearest(
    topology: Topology,
    vertices: Float[np.ndarray, "V 3"],
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
) -> Nearest:
    """The nearest places on a surface in metres and, through `TURN`, in direction."""
    pointing = vertex_normals(vertices, topology.faces)
    some = topology.whole
    tree = cKDTree(np.concatenate([vertices[some], TURN * pointing[some]], 1))
    close = tree.query(np.concatenate([points, TURN * normals], 1), k=2)[1]
    unit = face_normals(vertices, topology.faces)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    found = np.empty(len(points), np.int64)
    share = np.empty((len(points), 3))
    place = np.empty((len(points), 3))
    mesh = (np.ascontiguousarray(vertices), topology.faces, topology.start, topology.around)
    nearest_around(*mesh, np.ascontiguousarray(points), some[close], found, share, place)
    smooth = np.einsum("pk,pkc->pc", share, pointing[topology.faces[found]])
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    return Nearest(found, share, place, smooth, (smooth * normals).sum(1))


LEAST_REACH = 0.004
"""Metres from a vertex within which there has to be a point of the scan, however dense it is."""
SPACINGS = 2.0
"""The same in mean distances of the scan's points."""


def vertex_weights(
    topology: Topology, surface: Float[np.ndarray, "V 3"], cloud: Cloud
) -> Float[np.ndarray, " V"]:
    """1 where points of the scan are near a vertex and look its way, 0 where there is a hole,
    straight in between.
    """
    pointing = vertex_normals(surface, topology.faces)
    tree = cKDTree(np.concatenate([cloud.points, TURN * cloud.normals], 1))
    own = tree.query(tree.data[: min(2000, len(cloud.points))], k=2)[0][:, 1]
    reach = max(LEAST_REACH, SPACINGS * float(np.median(own)))
    away = tree.query(np.concatenate([surface, TURN * pointing], 1))[0]
    weights = np.zeros(len(surface))
    weights[topology.whole] = np.clip(2.0 - 0.5 * away[topology.whole] / reach, 0.0, 1.0)
    return weights


def hidden_vertices(body: BodyModel) -> Bool[np.ndarray, " V"] | None:
    """Vertices of pockets that nobody sees; None for a body that does not say."""
    full = body if body.mesh is not None else body.full
    if full is None or full.mesh is None:
        return None
    seen = np.zeros(full.num_vertices, dtype=bool)
    seen[np.unique(full.mesh.quads[~full.mesh.hidden])] = True
    return ~(seen if full is body else seen[body.full_vertices])
