"""Correspondences: for each scanned point the closest point of a surface with a similar normal.

    argmin over the surface  |t - q|^2 + c^2 |n_t - n_q|^2,    c = `NORMAL_DISTANCE`

where n_q is of length 1 and n_t as long as it is certain (`scan.plane_normals`), so that an
uncertain normal decides less. Also how well a scan covers each vertex of a registered surface, the
soles on the floor (thesis eq. 4.6), and the terms that fits to scans and depth views share, with
their own normal equations (thesis secs. 4.6.1 and 5.4):

    "shape"  1/2 (betas - b)^T P (betas - b)
    "pose"   1/2 sum_t (theta_t - m_t)^T P (theta_t - m_t)

theta_t: pose (J, 3) of scan or view t.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from habitus.body.measurements import find_soles
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.points.correspondence_kernels import nearest_around
from habitus.fit.points.depth_settings import RgbdSettings
from habitus.fit.points.scan import Cloud
from habitus.fit.points.settings import SCANS, SurfaceSettings
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointObservations, PointSolver, points_term
from habitus.solve.terms import Quadratic, Term, geman_mcclure_weight

NORMAL_DISTANCE = 0.06
"""c, metres: two points count as so far apart whose normals differ by 60 degrees. The metric of all
searches for correspondences, chosen by hand.
"""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Of N points: the face (N,) of the closest point, the weights of its corners (N, 3), the
    closest point itself (N, 3; m), the surface's normal there (N, 3), and the cosine (N,) between
    that and the point's own normal, c. For a normal of length l < 1 (its certainty) it is
    1 - l (1 - c): an uncertain normal does not rule a correspondence out.
    """

    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]
    closest: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    cosine: Float[np.ndarray, " N"]

    def distances(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """From the points to the surface (m)."""
        return np.linalg.norm(points - self.closest, axis=1)

    def outside(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """How far (m) the points lie off the surface along its normals."""
        return ((points - self.closest) * self.normal).sum(1)

    def weights(
        self,
        points: Float[np.ndarray, "N 3"],
        scale: float,
        min_cosine: float,
        ratio: float = 0.0,
    ) -> Float[np.ndarray, " N"]:
        """Robust weights: Geman-McClure of the distance, 0 where normals disagree. The scale is at
        least ``ratio`` times the median distance of the points whose normals agree.
        """
        distances = self.distances(points)
        agree = self.cosine > min_cosine
        if ratio and agree.any():
            scale = max(scale, ratio * float(np.median(distances[agree])))
        return geman_mcclure_weight(distances, scale) * agree


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
    cosine = (smooth * normals).sum(1) + 1.0 - np.linalg.norm(normals, axis=1)
    return Correspondences(face, share, closest, smooth, cosine)


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
    tree = KDTree(with_normals(cloud.points, cloud.unit_normals))
    spacing = tree.query(tree.data[: min(2000, len(cloud.points))], k=2)[0][:, 1]
    covering = max(settings.covering, settings.covering_spacings * float(np.median(spacing)))
    distance = tree.query(with_normals(surface, pointing))[0]
    weights = np.zeros(len(surface))
    weights[topology.whole] = np.clip(2.0 - 0.5 * distance[topology.whole] / covering, 0.0, 1.0)
    return weights


def hidden_vertices(body: BodyModel) -> Bool[np.ndarray, " V"] | None:
    """Vertices of pockets that nobody sees; None for a body that does not say."""
    if body.mesh is None:
        return body.pockets
    return body.mesh.pockets(np.arange(body.num_vertices))


def corners_of(
    faces: Int[np.ndarray, "F 3"], vertices: Int[np.ndarray, " N"]
) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Vertices of a mesh as corners of its faces: a face of each, and which of its corners."""
    order = np.argsort(faces.ravel(), kind="stable")
    first = order[np.searchsorted(faces.ravel(), vertices, sorter=order)]
    return first // 3, first % 3


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
        mean = np.zeros(body.num_betas) if body.people_mean is None else body.people_mean
        rest = body.rest_vertices(mean)[:, 1]
        return Footpads(*corners_of(body.faces, used), rest[used] - rest[used].min())

    def on_floor(
        self, surface: Float[np.ndarray, "V 3"], body: BodyModel, settings: RgbdSettings
    ) -> PointObservations:
        """E_F: drawn to their heights, all together with the weight of one; robust above the floor,
        as a foot may be lifted, and not below it, where no foot can be.
        """
        count = len(self.face)
        target = np.column_stack([np.zeros(count), self.height, np.zeros(count)])
        off = surface[body.faces[self.face, self.corner], 1] - self.height
        weight = settings.floor / settings.floor_sd**2 / count
        lifted = geman_mcclure_weight(np.maximum(off, 0.0), settings.floor_scale)
        root = np.sqrt(weight * lifted)
        return PointObservations(
            self.face,
            np.eye(3)[self.corner],
            target,
            root[:, None, None] * np.array([0.0, 1.0, 0.0]),
        )


def shape_prior(mean: Float[np.ndarray, " B"], precision: float) -> Term:
    """Betas about a mean, all with the same precision."""

    def residual(betas: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        return betas - mean, {"betas": np.eye(len(mean))}

    return Term(residual, precision, name="shape")


def pose_prior(mean: Float[np.ndarray, "*T n"], precision: Float[np.ndarray, "n n"]) -> Term:
    """Poses (T, J, 3) about a mean, one for all or one each; n = 3 J, rad."""

    def residual(pose: np.ndarray) -> Quadratic:
        difference = pose.reshape(len(pose), -1) - mean
        slope = difference @ precision

        def derivatives() -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
            return {"pose": slope}, {
                ("pose", "pose"): np.broadcast_to(precision, (len(pose), *precision.shape))
            }

        return Quadratic(0.5 * float((difference * slope).sum()), derivatives)

    return Term(residual, name="pose")


def about_root(precision: Float[np.ndarray, "m m"]) -> Float[np.ndarray, "n n"]:
    """A precision of all joints but the root as one of all joints, the root free."""
    size = len(precision) + 3
    whole = np.zeros((size, size))
    whole[3:, 3:] = precision
    return whole


def points_around(
    solver: PointSolver, state: BodyState, frames: Sequence[PointObservations | None]
) -> Term:
    """`points_term` of one set of points a frame, whose equations at ``state`` are computed at
    once: minimisation begins there.
    """
    elsewhere = points_term(solver, frames).residual
    size = solver.body.num_betas + 3 + 3 * solver.body.num_joints
    nothing = (0.0, np.zeros(size), np.zeros((size, size)))
    found = [
        nothing if points is None else solver.at(state.betas, pose, trans, points)
        for points, pose, trans in zip(frames, state.pose, state.trans, strict=True)
    ]
    here = Quadratic(
        sum(each[0] for each in found),
        lambda: by_unknown(solver.body, [(each[1], each[2]) for each in found]),
    )

    def residual(betas: np.ndarray, pose: np.ndarray, trans: np.ndarray) -> Quadratic:
        same = map(np.array_equal, (betas, pose, trans), (state.betas, state.pose, state.trans))
        return here if all(same) else elsewhere(betas=betas, pose=pose, trans=trans)

    return Term(residual)


def by_unknown(
    body: BodyModel,
    equations: Sequence[tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N N"]]],
) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
    """Gradients and matrices over betas, trans and pose of T scans, by unknowns."""
    head = body.num_betas
    gradient, matrix = (np.stack(part) for part in zip(*equations, strict=True))
    part = {"betas": slice(head), "trans": slice(head, head + 3), "pose": slice(head + 3, None)}
    pairs = [("trans", "trans"), ("trans", "pose"), ("pose", "pose")]
    pairs += [("trans", "betas"), ("pose", "betas")]
    blocks = {(a, b): matrix[:, part[a], part[b]] for a, b in pairs}
    blocks["betas", "betas"] = matrix[:, :head, :head].sum(0)
    slopes = {name: gradient[:, where] for name, where in part.items()}
    slopes["betas"] = slopes["betas"].sum(0)
    return slopes, blocks
