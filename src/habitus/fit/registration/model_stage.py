"""The model fitted to scans: pose and place of each, one shape for all, by Gauss-Newton (T 5.4).

    1/2 sum_p w_p ((n_p . (q_p - t_p))^2 + s |q_p - t_p|^2) + 1/2 l |betas|^2 + 1/2 m (theta -
    mean)^T P (theta - mean)

q is the point of the model that a scanned point t belongs to, found anew at each step; w falls with
the distance (Geman-McClure) and is zero where normals disagree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.registration.nearest import Nearest, Topology, nearest
from habitus.fit.registration.normals import agreed
from habitus.mesh.normals import vertex_normals
from habitus.residuals.robust import geman_mcclure_weight
from habitus.residuals.surface_points import PointMatches, SurfacePointSolver
from habitus.solve.arrow import ArrowMatrix

WORTH = 1500.0
"""Points that all points of a scan together count as: what is left of a scan after a fit is not
independent noise.
"""
LEAST_COSINE = 0.3
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
class Cloud:
    """Points (N, 3) of a scan, in metres and y up, and their normals (N, 3), outward; in random
    order.
    """

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]

    def first(self, count: int) -> "Cloud":
        """Some of them."""
        return Cloud(self.points[:count], self.normals[:count])


@dataclass(frozen=True, eq=False)
class ModelState:
    """One shape, and pose (T, J, 3) and trans (T, 3) of T scans."""

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]

    def one(self, k: int) -> "ModelState":
        """That of scan k alone."""
        return replace(self, pose=self.pose[k : k + 1], trans=self.trans[k : k + 1])


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

    solver: SurfacePointSolver
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

    def _matches(self, state: ModelState, k: int, cloud: Cloud, step: ModelStep) -> PointMatches:
        found = self.matched(state, k, cloud)
        apart = np.linalg.norm(cloud.points - found.place, axis=1)
        weight = geman_mcclure_weight(apart, step.reach) * (found.cosine > LEAST_COSINE)
        weight *= min(1.0, WORTH / len(apart)) / step.noise**2
        return PointMatches.to_planes(
            found.face, found.barycentric, cloud.points, found.normal, weight, step.slide
        )
