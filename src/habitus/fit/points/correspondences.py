"""Correspondences: for each scanned point the closest point of a surface with a similar normal.

    argmin over the surface  |t - q|^2 + c^2 |n_t - n_q|^2,    c = `NORMAL_DISTANCE`

how well a scan covers each vertex of a registered surface, and the soles on the floor (thesis
eq. 4.6).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.points.correspondence_kernels import nearest_around
from habitus.fit.points.depth_settings import RgbdSettings
from habitus.fit.points.scan import Cloud
from habitus.fit.points.settings import SCANS, SurfaceSettings
from habitus.fit.retarget.contacts import find_soles
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointObservations
from habitus.solve.terms import geman_mcclure_weight

NORMAL_DISTANCE = 0.06
"""c, metres: two points count as so far apart whose normals differ by 60 degrees. The metric of all
searches for correspondences, chosen by hand.
"""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Of N points: the face (N,) of the closest point, the weights of its corners (N, 3), the
    closest point itself (N, 3; m), the surface's normal there (N, 3), and the cosine (N,) between
    that and the point's own normal.
    """

    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]
    closest: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    cosine: Float[np.ndarray, " N"]

    def distances(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """From the points to the surface (m)."""
        return np.linalg.norm(points - self.closest, axis=1)

    def weights(
        self, points: Float[np.ndarray, "N 3"], scale: float, min_cosine: float
    ) -> Float[np.ndarray, " N"]:
        """Robust weights: Geman-McClure of the distance, 0 where normals disagree."""
        return geman_mcclure_weight(self.distances(points), scale) * (self.cosine > min_cosine)


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


def find_correspondences(
    topology: Topology,
    vertices: Float[np.ndarray, "V 3"],
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
) -> Correspondences:
    """The correspondences of points on a surface: by the two closest vertices, then on the faces
    around them.
    """
    pointing = vertex_normals(vertices, topology.faces)
    some = topology.whole
    tree = KDTree(with_normals(vertices[some], pointing[some]))
    close = tree.query(with_normals(points, normals), k=2)[1]
    face = np.empty(len(points), np.int64)
    share = np.empty((len(points), 3))
    closest = np.empty((len(points), 3))
    mesh = (np.ascontiguousarray(vertices), topology.faces, topology.start, topology.around)
    nearest_around(*mesh, np.ascontiguousarray(points), some[close], face, share, closest)
    smooth = np.einsum("pk,pkc->pc", share, pointing[topology.faces[face]])
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    return Correspondences(face, share, closest, smooth, (smooth * normals).sum(1))


def with_normals(points: np.ndarray, normals: np.ndarray) -> Float[np.ndarray, "*batch 6"]:
    """Points and normals in one space, whose distances are those that correspondences minimise."""
    return np.concatenate([points, NORMAL_DISTANCE * normals], -1)


def vertex_weights(
    topology: Topology,
    surface: Float[np.ndarray, "V 3"],
    cloud: Cloud,
    settings: SurfaceSettings = SCANS.surface,
) -> Float[np.ndarray, " V"]:
    """1 where points of the scan are near a vertex and look its way, 0 where there is a hole,
    straight in between.
    """
    pointing = vertex_normals(surface, topology.faces)
    tree = KDTree(with_normals(cloud.points, cloud.normals))
    spacing = tree.query(tree.data[: min(2000, len(cloud.points))], k=2)[0][:, 1]
    covering = max(settings.covering, settings.covering_spacings * float(np.median(spacing)))
    distance = tree.query(with_normals(surface, pointing))[0]
    weights = np.zeros(len(surface))
    weights[topology.whole] = np.clip(2.0 - 0.5 * distance[topology.whole] / covering, 0.0, 1.0)
    return weights


def hidden_vertices(body: BodyModel) -> Bool[np.ndarray, " V"] | None:
    """Vertices of pockets that nobody sees; None for a body that does not say."""
    full = body if body.mesh is not None else body.full
    if full is None or full.mesh is None:
        return None
    seen = np.zeros(full.num_vertices, dtype=bool)
    seen[np.unique(full.mesh.quads[~full.mesh.hidden])] = True
    return ~(seen if full is body else seen[body.full_vertices])


@dataclass(frozen=True, eq=False)
class Footpads:
    """Vertices of the soles as points of the surface: face and corner of each, and how high (m)
    above the floor each is where the foot stands flat: soles are arched, and round at their rims.
    """

    face: Int[np.ndarray, " P"]
    corner: Int[np.ndarray, " P"]
    height: Float[np.ndarray, " P"]

    @staticmethod
    def of(body: BodyModel) -> "Footpads | None":
        """Those of a body; None where it has no feet."""
        try:
            used = find_soles(body).used
        except HabitusError:
            return None
        order = np.argsort(body.faces.ravel(), kind="stable")
        first = order[np.searchsorted(body.faces.ravel(), used, sorter=order)]
        mean = np.zeros(body.num_betas) if body.people_mean is None else body.people_mean
        rest = body.rest_vertices(mean)[:, 1]
        return Footpads(first // 3, first % 3, rest[used] - rest[used].min())

    def on_floor(
        self, surface: Float[np.ndarray, "V 3"], body: BodyModel, settings: RgbdSettings
    ) -> PointObservations:
        """E_F: drawn to their heights, all together with the weight of one; robust, as a foot may
        be lifted.
        """
        count = len(self.face)
        target = np.column_stack([np.zeros(count), self.height, np.zeros(count)])
        off = surface[body.faces[self.face, self.corner], 1] - self.height
        weight = settings.floor / settings.floor_sd**2 / count
        root = np.sqrt(weight * geman_mcclure_weight(off, settings.floor_scale))
        return PointObservations(
            self.face,
            np.eye(3)[self.corner],
            target,
            root[:, None, None] * np.array([0.0, 1.0, 0.0]),
        )
