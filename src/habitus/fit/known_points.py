"""A person from points whose places on the body are known: vertices of another topology, mapped.

    minimise over betas, pose_f, trans_f   sum_fp |x_p(betas, pose_f) + trans_f - t_fp|^2 / s^2
                                           + a |betas|^2 + b |pose_f|^2

x_p lies on a known triangle at known barycentric coordinates (`habitus.residuals.points`). The
shape is solved on a few frames that differ most (the shape stage), then every frame's pose with
the shape held. Nothing is searched: each bone's points, turned rigidly from rest to their targets,
are the start (`start_pose`). a and b only decide what the points do not.

What the shape space leaves is taken back to the rest pose, averaged over frames and spread over
the surface as smoothly as it goes (`own_surface`): the person's own rest surface.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from habitus.body.jacobians import posed_skeleton
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.verdict import DOUBTFUL, GOOD, Bound, Reason, Verdict, above, verdict_of
from habitus.mesh.laplacian import cotangent_laplacian
from habitus.mesh.proximity import farthest_points
from habitus.mesh.surface_map import SurfaceMap
from habitus.residuals.points import PointObservations, PointSolver, points_on_surface, points_term
from habitus.residuals.shape_stage import pose_prior, shape_prior
from habitus.rotations import rotvec_from_matrix
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import minimize


@dataclass(frozen=True)
class KnownPointSettings:
    """Settings of the fit and limits of its verdict."""

    spread: float = 0.005
    """Metres (s) that a point lies off: about what a shape space leaves of a surface."""
    shape_prior: float = 1.0
    """a: betas are standard deviations; thousands of points outweigh it."""
    pose_prior: float = 0.01
    """b, 1 / rad^2: keeps joints that no point determines at rest."""
    frames: int = 8
    """Of the shape stage, at most. By hand: a whole surface determines the shape in one frame."""
    points: int = 1500
    """Of a frame's pose, spread evenly over the body; the shape stage takes twice as many. By
    hand."""
    of_joint: int = 60
    """Of these at least so many of each joint, as far as it has them: fingers are small."""
    iterations: int = 40
    """In each stage, at most."""
    tolerances: Tolerances = field(default_factory=lambda: Tolerances(cost=1e-4, step=1e-6))
    bend: float = 0.006
    """Metres over which a displaced surface bends: about the distance of SMPL's vertices, so that
    every vertex is followed, and noise between them is not."""
    least_area: float = 2e-6
    """m^2 of a vertex: smaller ones (the rims of eyes and lips) bend as these do."""
    off: Bound = Bound(0.010, 0.030)
    """Metres, mean distance of points: other people are 3 to 6 mm off in the bundled bodies' shape
    space; vertices in another order fail. By hand."""


KNOWN_POINTS = KnownPointSettings()
SENTENCES = {
    "off": "The body is {mm:.0f} mm from the vertices (mean): another order of vertices, another "
    "unit, or no adult's body."
}


@dataclass(frozen=True, eq=False)
class KnownPointFit:
    """Shape (B,), pose (T, J, 3; rad) and trans (T, 3; m) of the body, and the distances (T, N; m)
    of all points from where they should be.
    """

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    distances: Float[np.ndarray, "T N"]
    verdict: Verdict

    @property
    def error_mm(self) -> dict[str, float]:
        """Mean and 95th percentile of the distances in mm."""
        return error_mm(self.distances)


def error_mm(distances: Float[np.ndarray, "T N"]) -> dict[str, float]:
    """Mean and 95th percentile of distances (m) in mm."""
    return {
        "mean": 1e3 * float(distances.mean()),
        "p95": 1e3 * float(np.percentile(distances, 95)),
    }


def fit_known_points(
    body: BodyModel,
    face: Int[np.ndarray, " N"],
    barycentric: Float[np.ndarray, "N 3"],
    targets: Float[np.ndarray, "T N 3"],
    *,
    betas: Float[np.ndarray, " B"] | None = None,
    settings: KnownPointSettings = KNOWN_POINTS,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> KnownPointFit:
    """One person whose points on faces of ``body`` should be at ``targets`` (m) in T frames.

    betas: the shape, where it is known.

    Raises HabitusError where there are no frames, or fewer points than a shape needs.
    """
    if len(targets) == 0 or len(face) < body.num_betas + 6:
        raise HabitusError(
            f"{len(targets)} frames of {len(face)} points; expected one frame at least, and "
            f"{body.num_betas + 6} points or more"
        )
    solver = PointSolver.of(body)
    fitting = _Fitting(body, solver, face, barycentric, settings)
    progress("shape", 0.0)
    betas = fitting.shape(targets) if betas is None else betas
    few = _some(body, face, settings.points, settings.of_joint)
    coarse = _Fitting(body, solver, face[few], barycentric[few], settings)
    pose = np.empty((len(targets), body.num_joints, 3))
    trans = np.empty((len(targets), 3))
    distances = np.empty(targets.shape[:2])
    for k, target in enumerate(targets):
        pose[k], trans[k] = coarse.pose(betas, target[few])
        off = fitting.placed(betas, pose[k]) + trans[k] - target
        distances[k] = np.linalg.norm(off, axis=1)
        progress("pose", (k + 1.0) / len(targets))
    mean = float(distances.mean())
    level = above(mean, settings.off)
    reasons = [] if level == GOOD else [Reason(level or DOUBTFUL, "off", {"mm": 1e3 * mean})]
    return KnownPointFit(betas, pose, trans, distances, verdict_of(reasons, SENTENCES))


@dataclass(frozen=True, eq=False)
class _Fitting:
    body: BodyModel
    solver: PointSolver
    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]
    settings: KnownPointSettings

    def placed(self, betas: np.ndarray, pose: np.ndarray) -> Float[np.ndarray, "N 3"]:
        """The points (m) without translation."""
        vertices = self.body(betas, pose).vertices
        return points_on_surface(vertices, self.body.faces, self.face, self.barycentric)

    def shape(self, targets: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, " B"]:
        """The betas of some frames together."""
        chosen = _different(targets, self.settings.frames)
        few = _some(self.body, self.face, 2 * self.settings.points, self.settings.of_joint)
        fewer = _Fitting(
            self.body, self.solver, self.face[few], self.barycentric[few], self.settings
        )
        aims = targets[chosen][:, few]
        betas = np.zeros(self.body.num_betas)
        starts = [fewer.start(betas, aim) for aim in aims]
        pose, trans = (np.stack(each) for each in zip(*starts, strict=True))
        return fewer.solved(betas, pose, trans, aims, fixed=())["betas"]

    def pose(
        self, betas: Float[np.ndarray, " B"], target: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " 3"]]:
        """Pose and trans of one frame with the shape held."""
        pose, trans = self.start(betas, target)
        values = self.solved(betas, pose[None], trans[None], target[None], fixed=("betas",))
        return values["pose"][0], values["trans"][0]

    def start(
        self, betas: np.ndarray, target: np.ndarray
    ) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " 3"]]:
        """Each bone's points turned rigidly to their targets."""
        corners = self.body.faces[self.face]
        weights = np.einsum("nk,nkj->nj", self.barycentric, self.body.skinning_weights[corners])
        rest = self.placed(betas, np.zeros((self.body.num_joints, 3)))
        pose = start_pose(rest, target, weights, self.body.parents)
        return pose, (target - self.placed(betas, pose)).mean(0)

    def solved(
        self,
        betas: np.ndarray,
        pose: np.ndarray,
        trans: np.ndarray,
        targets: np.ndarray,
        fixed: tuple[str, ...],
    ) -> dict[str, np.ndarray]:
        """Where the energy is least."""
        settings = self.settings
        weight = np.full(len(self.face), settings.spread**-2)
        size = 3 * (self.body.num_joints - 1)
        frames = [
            PointObservations.to_points(self.face, self.barycentric, target, weight)
            for target in targets
        ]
        terms = {
            "points": points_term(self.solver, frames),
            "shape": shape_prior(self.body.num_betas, settings.shape_prior),
            "pose": pose_prior(np.zeros(size), np.eye(size), len(pose), settings.pose_prior),
        }
        return minimize(
            terms,
            {"betas": betas, "pose": pose, "trans": trans},
            "dogleg",
            fixed=fixed,
            blocks=("pose", "trans"),
            stretch=False,
            max_iterations=settings.iterations,
            tolerances=settings.tolerances,
        ).values


def _some(
    body: BodyModel, face: Int[np.ndarray, " N"], count: int, least: int
) -> Int[np.ndarray, " K"]:
    """Points spread evenly over the body, and over the small parts of single joints."""
    vertex = body.faces[face, 0]
    at, joint = body.v_template[vertex], body.strongest_joint[vertex]
    chosen = [farthest_points(at, count)]
    for k in np.unique(joint):
        own = np.flatnonzero(joint == k)
        chosen.append(own[farthest_points(at[own], least)])
    return np.unique(np.concatenate(chosen))


def _different(targets: Float[np.ndarray, "T N 3"], count: int) -> Int[np.ndarray, " K"]:
    """Frames that differ most in what their points do about their mean."""
    some = targets[:, :: max(1, targets.shape[1] // 200)]
    about = (some - some.mean(1, keepdims=True)).reshape(len(targets), -1)
    return farthest_points(about, count)


def start_pose(
    rest: Float[np.ndarray, "V 3"],
    target: Float[np.ndarray, "V 3"],
    influence: Float[np.ndarray, "V J"],
    parents: tuple[int, ...],
) -> Float[np.ndarray, "J 3"]:
    """A pose to start from (rotation vectors, rad): each joint's vertices turned rigidly from
    ``rest`` to ``target``.

    Joints whose vertices tell no rotation (none, or all on one line) go along with their parent.
    """
    w = influence / np.maximum(influence.sum(0), 1e-300)
    products = (target[:, :, None] * rest[:, None, :]).reshape(-1, 9)
    means = w.T @ target, w.T @ rest
    covariance = (w.T @ products).reshape(-1, 3, 3) - means[0][:, :, None] * means[1][:, None, :]
    u, s, vh = np.linalg.svd(covariance)
    side = np.where(np.linalg.det(u @ vh) < 0.0, -1.0, 1.0)
    determined = s[:, 1] + side * s[:, 2] > 1e-6 * np.maximum(s[:, 0], 1e-12)
    u[:, :, 2] *= side[:, None]
    world = u @ vh
    local = np.empty((len(w.T), 3, 3))
    for j, parent in enumerate(parents):
        above = world[parent] if parent >= 0 else np.eye(3)
        world[j] = world[j] if determined[j] else above
        local[j] = above.T @ world[j]
    return rotvec_from_matrix(local)


def own_surface(
    body: BodyModel,
    places: SurfaceMap,
    fit: KnownPointFit,
    targets: Float[np.ndarray, "T N 3"],
    settings: KnownPointSettings = KNOWN_POINTS,
) -> Float[np.ndarray, "V 3"]:
    """The rest surface (m) of the person: the shape's, moved so that the map's matched vertices
    meet their targets.

    targets: all N vertices of ``places`` in the frames of ``fit``, of which a few are averaged.
    """
    corners = places.corners
    weights = np.einsum("nk,nkj->nj", places.barycentric, body.skinning_weights[corners])
    missing = np.zeros(targets.shape[1:])
    chosen = _different(targets, settings.frames)
    for k in chosen:
        world = posed_skeleton(body, body.rest_joints(fit.betas), fit.pose[k]).world
        turn = np.einsum("nj,jab->nab", weights, world[..., :3])
        off = targets[k] - fit.trans[k]
        off -= places.vertices(body(fit.betas, fit.pose[k]).vertices)
        missing += np.linalg.solve(turn, off[..., None])[..., 0] / len(chosen)
    rest = body.rest_vertices(fit.betas)
    return rest + spread(rest, body.faces, places, missing, settings)


def spread(
    surface: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    places: SurfaceMap,
    missing: Float[np.ndarray, "N 3"],
    settings: KnownPointSettings = KNOWN_POINTS,
) -> Float[np.ndarray, "V 3"]:
    """Displacements (m) of a surface's vertices that move its matched places by ``missing``, as
    smooth as that allows: a thin plate holds them, and bends over about `KnownPointSettings.bend`.
    """
    kept = np.flatnonzero(places.matched)
    rows = places.matrix()[kept]
    laplacian, area = cotangent_laplacian(surface, faces)
    area = np.maximum(area, settings.least_area)
    plate = laplacian.T @ diags_array(1.0 / area) @ laplacian
    hold = diags_array(1e-6 * area)
    share = area.sum() / len(kept)
    matrix = share * rows.T @ rows + settings.bend**4 * plate + hold
    return splu(csc_array(matrix)).solve(share * (rows.T @ missing[kept]))
