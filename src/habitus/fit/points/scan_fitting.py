"""The model fitted to scans: pose and place of each, one shape for all, by Gauss-Newton (T 5.4).

    1/2 sum_p w_p ((n_p . (q_p - t_p))^2 + s |q_p - t_p|^2) + 1/2 l |betas|^2 + 1/2 m (theta -
    mean)^T P (theta - mean)

q is the point of the model that a scanned point t belongs to, found anew at each step; w falls with
the distance (Geman-McClure) and is zero where normals disagree.

The model fitted while skin lies off it, as skin does that no model knows: pose, shape and that
offset at once.

    1/2 sum_p w_p (n_p . (q_p - t_p) + h_p)^2 + 1/2 h^T Q h + 1/2 |betas|^2 + 1/2 (theta - mean)^T P
    (theta - mean)

h (V,) is how far the skin is off the model along its normals: a random field over the surface, of
Matern's kind, whose precision Q is (k^2 + Laplacian)^2. What is left of a scan after a fit is alike
over centimetres, so that a thousand points on a thigh tell of its place hardly more than one:
without h they would count as if each told anew, and the model would slide along the skin after
them. h is linear and taken out of each step exactly (Schur); pose and shape then see what a smooth
offset cannot explain, the form of a knee sooner than the girth of a thigh. In a sequence h, betas
and theta are held near those of the frame before, instead of near people's mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.spatial import cKDTree

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.points.correspondences import Nearest, Topology, nearest
from habitus.fit.points.free_surface import factored
from habitus.fit.points.scan import Cloud, agreed
from habitus.fit.points.state import ModelState
from habitus.mesh.laplacian import cotangent_laplacian
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointObservations, PointSolver
from habitus.residuals.robust import geman_mcclure_weight
from habitus.solve.arrow import ArrowMatrix

WORTH = 1500.0
"""Points that all points of a scan together count as: what is left of a scan after a fit is not
independent noise.
"""
MODEL_MIN_COSINE = 0.3
ORIENTED = 0.03
"""Metres from the model within which it says which way a surface looks."""
SHAPE_CHANGE = 0.5
"""Standard deviations by which betas of one frame of a sequence differ from those of the one
before.
"""
MOST_TURN = 0.6
"""Radians that a joint turns in a step at most."""


@dataclass(frozen=True)
class ModelStep:
    """Some Gauss-Newton steps alike: ``points`` of each scan, ``reach`` (m) beyond which a point
    hardly counts, ``noise`` (m, sd) of a point, the share ``slide`` of point to point, and how many
    of the betas are free.
    """

    steps: int
    points: int
    reach: float
    noise: float
    slide: float
    betas: int
    pose: float = 1.0
    """Weight of the pose prior."""
    shape: float = 1.0


@dataclass(frozen=True, eq=False)
class FrameBefore:
    """What the frame before says of the next one of a sequence: betas (B,), pose (J, 3), and how
    far the skin was off the model along its normals (V,; m).
    """

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "J 3"]
    offset: Float[np.ndarray, " V"]


@dataclass(frozen=True, eq=False)
class ModelFitter:
    """A body made ready to be fitted to scans; ``before`` couples them in time."""

    solver: PointSolver
    topology: Topology
    prior: PosePrior
    before: FrameBefore | None = None

    @property
    def body(self) -> BodyModel:
        """The body."""
        return self.solver.body

    def vertices(self, state: ModelState, k: int = 0) -> Float[np.ndarray, "V 3"]:
        """The surface of scan k."""
        return np.asarray(self.body(state.betas, state.pose[k], state.trans[k]).vertices)

    def matched(self, state: ModelState, k: int, cloud: Cloud) -> Nearest:
        """Where on the model each point of a scan belongs."""
        return nearest(self.topology, self.vertices(state, k), cloud.points, cloud.normals)

    def oriented(self, state: ModelState, cloud: Cloud) -> Cloud:
        """The cloud with its normals on the model's side where it is near, whichever side they were
        carried to.
        """
        surface = self.vertices(state)
        some = self.topology.whole
        _, which = cKDTree(surface[some]).query(cloud.points, distance_upper_bound=ORIENTED)
        pointing = np.concatenate(
            [vertex_normals(surface, self.topology.faces)[some], np.zeros((1, 3))]
        )
        return Cloud(cloud.points, agreed(cloud.points, cloud.normals, pointing[which]))

    def fit(
        self, state: ModelState, clouds: Sequence[Cloud], schedule: Sequence[ModelStep]
    ) -> ModelState:
        """The state after all steps of a schedule."""
        for step in schedule:
            some = [cloud.first(step.points) for cloud in clouds]
            for _ in range(step.steps):
                state = self._step(state, some, step)
        return state

    def _step(self, state: ModelState, clouds: Sequence[Cloud], step: ModelStep) -> ModelState:
        matches = [self._matches(state, k, cloud, step) for k, cloud in enumerate(clouds)]
        _, gradient, matrix = self.solver.together(state.betas, state.pose, state.trans, matches)
        return self.moved(state, gradient, matrix, step)

    def moved(
        self,
        state: ModelState,
        gradient: Float[np.ndarray, " n"],
        matrix: ArrowMatrix,
        step: ModelStep,
    ) -> ModelState:
        """The state after one step by what the scans say, gradient and matrix (betas, then trans
        and pose of each), and by the priors.
        """
        gradient = gradient.copy()
        count = self.body.num_betas
        size = 3 + 3 * self.body.num_joints
        precision = step.pose * self.prior.precision
        mean = self.prior.mean
        usual = np.zeros(count)
        shape = step.shape
        if self.before is not None:
            mean = self.before.pose[1:].ravel()
            usual = self.before.betas
            shape = step.shape / SHAPE_CHANGE**2
        gradient[:count] += shape * (state.betas - usual)
        shared = matrix.shared + shape * np.eye(count)
        blocks = matrix.blocks.copy()
        for k, pose in enumerate(state.pose):
            begin = count + k * size + 6
            gradient[begin : begin + len(mean)] += precision @ (pose[1:].ravel() - mean)
            blocks[k][6:, 6:] += precision
        held = np.arange(count) >= step.betas
        shared[held] = shared[:, held] = 0.0
        shared[held, held] = 1.0
        border = np.where(held, 0.0, matrix.border)
        gradient[:count][held] = 0.0
        arrow = ArrowMatrix(shared, border, blocks)
        change = arrow.solve(1e-4 * arrow.diagonal() + 1e-9, -gradient)
        each = change[count:].reshape(len(state.pose), size)
        turn = each[:, 3:].reshape(state.pose.shape)
        turn *= min(1.0, MOST_TURN / max(np.abs(turn).max(initial=0.0), 1e-12))
        return ModelState(
            state.betas + change[:count], state.pose + turn, state.trans + each[:, :3]
        )

    def _matches(
        self, state: ModelState, k: int, cloud: Cloud, step: ModelStep
    ) -> PointObservations:
        found = self.matched(state, k, cloud)
        apart = np.linalg.norm(cloud.points - found.place, axis=1)
        weight = geman_mcclure_weight(apart, step.reach) * (found.cosine > MODEL_MIN_COSINE)
        weight *= min(1.0, WORTH / len(apart)) / step.noise**2
        return PointObservations.to_planes(
            found.face, found.barycentric, cloud.points, found.normal, weight, step.slide
        )


OFFSET, BONY_OFFSET = 0.004, 0.002
"""Metres (sd): how far skin is off a model, and on hands, feet and head."""
BONY = ("hand", "wrist", "foot", "head", "toe")
OFFSET_CHANGE = 0.8
"""Of that, how much the offset changes from one frame of a sequence to the next."""
RANGE = 0.19
"""Metres: from there on two places' offsets have little to do with each other (a correlation of
0.14).
"""
OFFSET_MIN_COSINE = 0.5
EVERYTHING = 1000
OFFSET_STEPS = (
    ModelStep(3, 8000, 0.05, 0.01, 0.0, EVERYTHING),
    ModelStep(2, 16_000, 0.03, 0.004, 0.0, EVERYTHING),
    ModelStep(3, 40_000, 0.02, 0.0025, 0.0, EVERYTHING),
)
"""The noise is that of a point which the offset does not explain: of the scanner, and of skin's
finer forms.
"""


def offset_spread(body: BodyModel) -> Float[np.ndarray, " V"]:
    """The offset's standard deviation (m) at each vertex."""
    bony = [k for k, name in enumerate(body.joint_names) if name.rpartition("_")[2] in BONY]
    share = body.skinning_weights[:, bony].sum(1)
    return OFFSET * (1.0 - share) + BONY_OFFSET * share


def field_precision(
    topology: Topology,
    vertices: Float[np.ndarray, "V 3"],
    spread: Float[np.ndarray, " V"],
    reach: float = RANGE,
) -> csc_array:
    """The precision (V, V; 1 / m^2) of a Matern field (of smoothness 1) on a mesh with that spread
    (m).
    """
    laplacian, area = cotangent_laplacian(vertices, topology.faces)
    inverse = np.sqrt(8.0) / reach
    half = inverse**2 * diags_array(area) + laplacian
    whole = half @ diags_array(1.0 / area) @ half / (4.0 * np.pi * inverse**2)
    return csc_array(diags_array(1.0 / spread) @ whole @ diags_array(1.0 / spread))


@dataclass(frozen=True, eq=False)
class _Pull:
    """What a scan says of a state: gradient (N,) and matrix (N, N) without the offset, and what the
    offset becomes, ``offset - slope @ change``, by a change (N,) of the state.
    """

    gradient: Float[np.ndarray, " N"]
    matrix: Float[np.ndarray, "N N"]
    offset: Float[np.ndarray, " V"]
    slope: Float[np.ndarray, "V N"]


def fit_with_offsets(
    fitter: ModelFitter,
    state: ModelState,
    clouds: Sequence[Cloud],
    schedule: Sequence[ModelStep] = OFFSET_STEPS,
    along: Sequence[PointObservations] | None = None,
) -> tuple[ModelState, list[Float[np.ndarray, "V 3"]]]:
    """The state of all scans (one shape), and of each the surface: the model with its offset (m).

    along: of each scan what else is known of places along the skin, where the offset has no say:
    colours.
    """
    before = fitter.before
    spread = offset_spread(fitter.body)
    mean = np.zeros(fitter.body.num_vertices) if before is None else before.offset
    spread = spread if before is None else OFFSET_CHANGE * spread
    offsets = [mean] * len(clouds)
    held = [
        field_precision(fitter.topology, fitter.vertices(state, k), spread)
        for k in range(len(clouds))
    ]
    for step in schedule:
        for _ in range(step.steps):
            few = [cloud.first(step.points) for cloud in clouds]
            pulls = [
                _pull(fitter, state.one(k), few[k], held[k], offsets[k], mean, step)
                for k in range(len(clouds))
            ]
            if along is not None:
                pulls = [
                    _along(fitter, state.one(k), *each)
                    for k, each in enumerate(zip(pulls, along, strict=True))
                ]
            moved = fitter.moved(state, *_together(fitter.body.num_betas, pulls), step)
            changes = [_change(state.one(k), moved.one(k)) for k in range(len(clouds))]
            offsets = [
                pull.offset - pull.slope @ change
                for pull, change in zip(pulls, changes, strict=True)
            ]
            state = moved
    return state, [_off(fitter, state, k, offset) for k, offset in enumerate(offsets)]


def _along(
    fitter: ModelFitter, state: ModelState, pull: _Pull, matches: PointObservations
) -> _Pull:
    more = fitter.solver.at(state.betas, state.pose[0], state.trans[0], matches)
    return replace(pull, gradient=pull.gradient + more.gradient, matrix=pull.matrix + more.matrix)


def _off(
    fitter: ModelFitter, state: ModelState, k: int, offset: np.ndarray
) -> Float[np.ndarray, "V 3"]:
    surface = fitter.vertices(state, k)
    return surface + offset[:, None] * vertex_normals(surface, fitter.topology.faces)


def _change(before: ModelState, after: ModelState) -> Float[np.ndarray, " N"]:
    parts = (after.betas - before.betas, after.trans - before.trans, after.pose - before.pose)
    return np.concatenate([part.ravel() for part in parts])


def _pull(
    fitter: ModelFitter,
    state: ModelState,
    cloud: Cloud,
    held: csc_array,
    offset: np.ndarray,
    mean: np.ndarray,
    step: ModelStep,
) -> _Pull:
    """One scan at one state: points against planes, which belong where model and offset have them.

    The offset's own energy is of what it differs by from ``mean`` (V,).
    """
    body = fitter.body
    faces = fitter.topology.faces
    slopes = surface_jacobian(body, state.betas, state.pose[0], state.trans[0])
    model = np.asarray(slopes.surface.vertices)
    normal = vertex_normals(model, faces)
    count = len(model)
    found = nearest(fitter.topology, model + offset[:, None] * normal, cloud.points, cloud.normals)
    apart = np.linalg.norm(cloud.points - found.place, axis=1)
    weight = geman_mcclure_weight(apart, step.reach) * (found.cosine > OFFSET_MIN_COSINE)
    weight /= step.noise**2
    corners = faces[found.face]
    row = np.repeat(np.arange(len(corners)), 3)
    share = coo_array(
        (found.barycentric.ravel(), (row, corners.ravel())), shape=(len(corners), count)
    ).tocsr()
    there = np.einsum("pk,pkc->pc", found.barycentric, model[corners])
    missing = ((cloud.points - there) * found.normal).sum(1) - share @ mean
    lumped = csc_array(share.T @ diags_array(weight) @ share)
    wanted = share.T @ (weight * missing)
    by_betas, by_pose = (
        np.einsum("vc,vcn->vn", normal, each.reshape(count, 3, -1))
        for each in (slopes.vertices_betas, slopes.vertices_pose)
    )
    along = np.concatenate([by_betas, normal, by_pose], 1)
    told = np.column_stack([lumped @ along, wanted])
    taken = factored(csc_array(lumped + held)).solve(told)
    left = told - lumped @ taken
    return _Pull(-along.T @ left[:, -1], along.T @ left[:, :-1], mean + taken[:, -1], taken[:, :-1])


def _together(head: int, pulls: Sequence[_Pull]) -> tuple[Float[np.ndarray, " n"], ArrowMatrix]:
    """Gradient and matrix of all scans: betas, which they share, then trans and pose of each."""
    shared = np.sum([pull.matrix[:head, :head] for pull in pulls], axis=0)
    border = np.stack([pull.matrix[head:, :head] for pull in pulls])
    blocks = np.stack([pull.matrix[head:, head:] for pull in pulls])
    top = np.sum([pull.gradient[:head] for pull in pulls], axis=0)
    return np.concatenate([top, *(pull.gradient[head:] for pull in pulls)]), ArrowMatrix(
        shared, border, blocks
    )
