"""The body model fitted to scans: shape of the person, pose and translation of each scan (thesis
sec. 5.4; weights of all terms and full citations in `habitus.fit.points`).

    "points"  1/2 c sum_p w_p ((n_p . (q_p - t_p))^2 + s |q_p - t_p|^2)
    "offset"  min over h of  1/2 sum_p w_p (n_p . (q_p - t_p) + h_p)^2
                             + 1/2 (h - h0)^T Q (h - h0)
    "colour"  1/2 sum_p |D_p (q_p - t_p)|^2,    places along the skin from colours (`skin_colours`)
    "shape"   1/2 lambda_shape |betas - betas0|^2
    "pose"    1/2 lambda_pose (theta - theta0)^T P (theta - theta0),    the root is free

t_p is a scanned point and q_p its correspondence on the model, the nearest point with a similar
normal n_p, renewed before each step; w_p = 1 / noise^2 falls with the distance (Geman-McClure)
and is zero where normals disagree. First "points" and the priors from coarse to fine; c = min(1,
`effective_points` / N) counts the N points of a scan as 1500 at most, since what a fit leaves of a
scan is no independent noise. Then "offset" in place of "points", without c, noise being that of the
scan's number of points (`ScanStage.noise_of`): h (V,) are skin offsets along the normals of the
model, a random field with precision Q (`habitus.fit.offsets`). h is linear
and eliminated from each step exactly (variable projection, Golub and Pereyra 1973): pose and shape
then follow what a smooth offset cannot explain, the form of a knee sooner than the girth of a
thigh. The scale of w_p is then at least `ScanSettings.scale_ratio` times the median distance, and
scale and noise fall from stage to stage: points in wrong places count less and less.

betas0 are 0 and theta0 is the prior's mean. h0 is m0: the thickness of tight clothes and of hair
(`habitus.fit.points.clothes`, also for the weights w_p under loose clothes and of hair), 0
elsewhere. Several scans of a person share h0 where `ScanStage.own_offsets`, a, is below 1:
h0 ~ N(m0, (1 - a^2) Q^-1) is renewed before each step from all h (`shared_offset`), and each h lies
about it with precision Q / a^2. In a sequence all three are those of the frame before,
lambda_shape is divided by `shape_change`^2 and Q by `offset_change`^2.
lambda_shape and lambda_pose are `ScanStage.shape` and `.pose`; s is `ScanStage.slide`.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU
from scipy.spatial import KDTree

from habitus.body.jacobians import SurfaceJacobian, surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.fit.offsets import (
    along_normals,
    factored,
    field_precision,
    inverse_product,
    motion_along,
    offset_spread,
)
from habitus.fit.points.clothes import Clothes, hair_thickness
from habitus.fit.points.correspondences import (
    Correspondences,
    Topology,
    about_root,
    by_unknown,
    find_correspondences,
    points_around,
    pose_prior,
    shape_prior,
)
from habitus.fit.points.scan import Cloud, agreed, neighbours_of
from habitus.fit.points.scan_stage import ScanStage
from habitus.fit.points.settings import SCANS, ScanSettings
from habitus.fit.points.skin_offsets import scalp, scalp_at
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointObservations, PointSolver, points_term
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import alternate
from habitus.solve.terms import Quadratic, Term


@dataclass(frozen=True, eq=False)
class PreviousFrame:
    """The fit of the frame before in a sequence: betas (B,), pose (J, 3), skin offsets (V,; m)."""

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "J 3"]
    offset: Float[np.ndarray, " V"]


@dataclass(frozen=True, eq=False)
class OffsetPrior:
    """Mean and standard deviation (V,; m) of skin offsets, with tight clothes and hair."""

    mean: Float[np.ndarray, " V"]
    spread: Float[np.ndarray, " V"]


@dataclass(frozen=True, eq=False)
class OffsetFit:
    """A state, the prior of skin offsets, the surfaces (m) with them, and how the solve ended:
    `status` of `habitus.minimize`, the cost of each term after the last step.
    """

    state: BodyState
    prior: OffsetPrior
    surfaces: tuple[Float[np.ndarray, "V 3"], ...]
    status: str
    costs: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class ScanFitter:
    """A body prepared for fits to scans; ``previous`` couples it to the frame before."""

    solver: PointSolver
    topology: Topology
    prior: PosePrior
    previous: PreviousFrame | None = None
    settings: ScanSettings = SCANS

    @cached_property
    def precision(self) -> Float[np.ndarray, "n n"]:
        """Of the pose prior, without the root."""
        return self.prior.precision

    @cached_property
    def clothes(self) -> Clothes:
        """What the person wears."""
        return Clothes.of(self.body, self.settings.clothes)

    @cached_property
    def scalp(self) -> Float[np.ndarray, " V"]:
        """1 where hair may grow, 0 elsewhere."""
        return scalp(self.body, self.settings.hair.hairline)

    @property
    def body(self) -> BodyModel:
        """The body."""
        return self.solver.body

    def vertices(self, state: BodyState, k: int = 0) -> Float[np.ndarray, "V 3"]:
        """The surface of scan k."""
        return np.asarray(self.body(state.betas, state.pose[k], state.trans[k]).vertices)

    def matched(self, state: BodyState, k: int, cloud: Cloud) -> Correspondences:
        """The correspondences of a scan's points on the model."""
        return find_correspondences(
            self.topology, self.vertices(state, k), cloud.points, cloud.normals
        )

    def distances(self, surface: Float[np.ndarray, "V 3"], cloud: Cloud) -> Float[np.ndarray, " N"]:
        """Distances (m) of a scan's points from a surface; 0 for cloth that hangs off it."""
        found = find_correspondences(self.topology, surface, cloud.points, cloud.normals)
        hanging = self.clothes.hanging(found, self.topology.faces[found.face], cloud.points)
        return np.where(hanging, 0.0, found.distances(cloud.points))

    def oriented(self, surface: Float[np.ndarray, "V 3"], cloud: Cloud) -> Cloud:
        """The cloud with normals on the side of a surface (m) of the body where that is near."""
        some = self.topology.whole
        _, which = KDTree(surface[some]).query(
            cloud.points, distance_upper_bound=self.settings.orientation_distance
        )
        pointing = vertex_normals(surface, self.topology.faces)[some]
        others = np.concatenate([pointing, np.zeros((1, 3))])[which]
        count = self.settings.cleaning.normal_neighbours
        near = neighbours_of(cloud.points, count) if cloud.signed else None
        return replace(cloud, normals=agreed(cloud.normals, others, near))

    def offset_prior(self, state: BodyState, clouds: Sequence[Cloud]) -> OffsetPrior:
        """The prior of skin offsets in a fit that starts at a state, where hair is measured: its
        thickness is both mean and standard deviation.
        """
        spread = offset_spread(self.body, self.settings.offsets)
        thickness = self.clothes.thickness
        if self.previous is not None:
            mean = thickness + self.previous.offset
            return OffsetPrior(mean, self.settings.offset_change * spread)
        hair = self.hair(state, clouds)
        return OffsetPrior(thickness + hair, np.hypot(spread, hair))

    def hair(self, state: BodyState, clouds: Sequence[Cloud]) -> Float[np.ndarray, " V"]:
        """The thickness (V,; m) of hair over the model: that of the median scan; 0 below
        `HairSettings.least_thickness`, and where clothes describe it.
        """
        if self.settings.clothes.covers_hair:
            return np.zeros(self.body.num_vertices)
        thickness = np.median([self._hair_of(state, k, cloud) for k, cloud in enumerate(clouds)])
        return self.scalp * (thickness if thickness >= self.settings.hair.least_thickness else 0.0)

    def _hair_of(self, state: BodyState, k: int, cloud: Cloud) -> float:
        few = cloud.first(self.settings.hair.points)
        found = self.matched(state, k, few)
        return hair_thickness(
            found.outside(few.points),
            found.distances(few.points),
            scalp_at(self.scalp, self.topology.faces[found.face], found.barycentric),
            self.settings.hair,
        )

    def fit(
        self, state: BodyState, clouds: Sequence[Cloud], schedule: Sequence[ScanStage]
    ) -> BodyState:
        """The state after all stages, without skin offsets."""

        def terms_at(values: dict[str, Any], stage: ScanStage, step: int) -> dict[str, Term]:
            now = BodyState(**values)
            points = [self.points(now, k, cloud, stage) for k, cloud in enumerate(clouds)]
            return {"points": points_around(self.solver, now, points), **self.priors(stage)}

        return self.minimized(terms_at, state, schedule).state

    def fit_with_offsets(
        self,
        state: BodyState,
        clouds: Sequence[Cloud],
        schedule: Sequence[ScanStage],
        colours: Sequence[PointObservations] | None = None,
    ) -> OffsetFit:
        """The state of all scans (one shape), and of each the surface: the model with its offset.

        colours: of each scan, places along the skin, where offsets have no part.
        """
        prior = self.offset_prior(state, clouds)
        mean = prior.mean
        models = [self.vertices(state, k) for k in range(len(clouds))]
        alone = len(clouds) == 1 or self.previous is not None
        own = [1.0 if alone else stage.own_offsets for stage in schedule]
        precisions = {
            (share, smoothness): [
                self._field(model, share * prior.spread, smoothness) for model in models
            ]
            for share, smoothness in {
                (share, stage.smoothness) for share, stage in zip(own, schedule, strict=True)
            }
        }
        scans: list[OffsetEquations] = []  # those of the last step, from which offsets carry over

        def terms_at(values: dict[str, Any], stage: ScanStage, step: int) -> dict[str, Term]:
            nonlocal scans, mean
            now = BodyState(**values)
            share = 1.0 if alone else stage.own_offsets
            if scans and not alone:
                offsets = [scan.offset_at(self.vertices(now, k)) for k, scan in enumerate(scans)]
                mean = prior.mean + shared_offset(np.array(offsets) - prior.mean, share)
            scans = [
                OffsetEquations.of(
                    self,
                    now[k : k + 1],
                    cloud,
                    precisions[share, stage.smoothness][k],
                    mean,
                    stage,
                    scans[k] if scans else None,
                )
                for k, cloud in enumerate(clouds)
            ]
            terms = {"offset": offset_term(scans), **self.priors(stage)}
            if colours is not None:
                terms["colour"] = points_term(self.solver, list(colours))
            return terms

        minimized = self.minimized(terms_at, state, schedule)
        models = [self.vertices(minimized.state, k) for k in range(len(clouds))]
        surfaces = tuple(
            along_normals(model, scan.offset_at(model), self.body)
            for model, scan in zip(models, scans, strict=True)
        )
        return OffsetFit(minimized.state, prior, surfaces, minimized.status, minimized.costs)

    def minimized(self, terms_at: Any, state: BodyState, schedule: Sequence[ScanStage]) -> Any:
        """The solve of a schedule: correspondences renewed before each step."""
        count = np.arange(self.body.num_betas)
        stages = [
            replace(
                stage,
                masks={"betas": count < stage.betas},
                max_step={"pose": self.settings.max_joint_step},
                fixed=() if stage.betas else ("betas",),
            )
            for stage in schedule
        ]
        return alternate(
            terms_at,
            state,
            stages,
            steps=Levenberg(self.settings.damping),
            blocks=("trans", "pose"),
        )

    def _field(
        self, model: np.ndarray, spread: Float[np.ndarray, " V"], smoothness: int
    ) -> csc_array:
        """The precision of skin offsets on a posed model."""
        correlated = self.settings.offsets.range
        return field_precision(self.topology.faces, model, spread, correlated, smoothness)

    def priors(self, stage: ScanStage) -> dict[str, Term]:
        """Those of shape and pose."""
        betas = np.zeros(self.body.num_betas)
        mean = np.concatenate([np.zeros(3), self.prior.mean])
        shape = stage.shape
        if self.previous is not None:
            betas = self.previous.betas
            mean = self.previous.pose.ravel()
            shape = stage.shape / self.settings.shape_change**2
        precision = about_root(stage.pose * self.precision)
        return {"shape": shape_prior(betas, shape), "pose": pose_prior(mean, precision)}

    def points(self, state: BodyState, k: int, cloud: Cloud, stage: ScanStage) -> PointObservations:
        """The points of scan k, drawn to the model as a stage has it."""
        cloud = cloud.first(stage.points)
        correspondences = self.matched(state, k, cloud)
        weight = correspondences.weights(cloud.points, stage.scale, self.settings.model_min_cosine)
        corners = self.topology.faces[correspondences.face]
        hair = scalp_at(self.scalp, corners, correspondences.barycentric)
        weight *= 1.0 - (1.0 - stage.scalp_weight) * hair
        variance = stage.noise**2 / min(1.0, self.settings.effective_points / len(weight))
        weight *= self.clothes.factor(correspondences, corners, cloud.points, variance) / variance
        return PointObservations.to_planes(
            correspondences.face,
            correspondences.barycentric,
            cloud.points,
            correspondences.normal,
            weight,
            stage.slide,
        )


def shared_offset(offsets: Float[np.ndarray, "K V"], own: float) -> Float[np.ndarray, " V"]:
    """The most probable offset that the scans of a person share, given the offset of each, with
    their median in place of their mean: one scan in a wrong pose does not count.
    """
    count = len(offsets)
    return np.median(offsets, 0) * count * (1.0 - own**2) / (count * (1.0 - own**2) + own**2)


@dataclass(frozen=True, eq=False)
class OffsetEquations:
    """Points of one scan against planes, skin offsets eliminated, around a state.

    With d (V,) the displacement of vertices along the normals they have at that state, S the points
    by vertices, W their weights, r what is missing to their planes and delta = h - mean:

        1/2 |S (d + delta) - r|_W^2 + 1/2 delta^T Q delta,    delta = (L + Q)^-1 (b - L d)

    lumped: L = S^T W S. pull: b = S^T W r. square: r^T W r.
    """

    body: BodyModel
    state: BodyState
    model: Float[np.ndarray, "V 3"]
    normal: Float[np.ndarray, "V 3"]
    lumped: csc_array
    pull: Float[np.ndarray, " V"]
    square: float
    factor: SuperLU
    mean: Float[np.ndarray, " V"]
    jacobian: SurfaceJacobian

    @staticmethod
    def of(
        fitter: ScanFitter,
        state: BodyState,
        cloud: Cloud,
        precision: csc_array,
        mean: Float[np.ndarray, " V"],
        stage: ScanStage,
        last: "OffsetEquations | None" = None,
    ) -> "OffsetEquations":
        """Correspondences on the model with the offset of the last step, or the mean offset."""
        with ThreadPoolExecutor(1) as pool:
            here = (state.betas, state.pose[0], state.trans[0])
            jacobian = pool.submit(surface_jacobian, fitter.body, *here)
            faces = fitter.topology.faces
            cloud = cloud.first(stage.points)
            model = fitter.vertices(state)
            normal = vertex_normals(model, faces)
            offset = mean if last is None else last.offset_at(model)
            surface = model + offset[:, None] * normal
            if stage.renewed_signs and not cloud.signed:
                cloud = fitter.oriented(surface, cloud)
            correspondences = find_correspondences(
                fitter.topology, surface, cloud.points, cloud.normals
            )
            settings = fitter.settings
            weight = correspondences.weights(
                cloud.points, stage.scale, settings.offset_min_cosine, settings.scale_ratio
            )
            variance = stage.noise_of(len(weight)) ** 2
            corners = faces[correspondences.face]
            weight *= fitter.clothes.factor(correspondences, corners, cloud.points, variance)
            weight /= variance
            row = np.repeat(np.arange(len(corners)), 3)
            share = coo_array(
                (correspondences.barycentric.ravel(), (row, corners.ravel())),
                shape=(len(corners), len(model)),
            ).tocsr()
            there = np.einsum("pk,pkc->pc", correspondences.barycentric, model[corners])
            missing = ((cloud.points - there) * correspondences.normal).sum(1) - share @ mean
            lumped = csc_array(share.T @ diags_array(weight) @ share)
            return OffsetEquations(
                fitter.body,
                state,
                model,
                normal,
                lumped,
                share.T @ (weight * missing),
                float(weight @ missing**2),
                factored(csc_array(lumped + precision)),
                mean,
                jacobian.result(),
            )

    def model_at(
        self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray
    ) -> Float[np.ndarray, "V 3"]:
        """The model's vertices (m) at a state."""
        if self._is_here(betas, pose, trans):
            return self.model
        return np.asarray(self.body(betas, pose, trans).vertices)

    def _is_here(self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray) -> bool:
        here = (self.state.betas, self.state.pose[0], self.state.trans[0])
        return all(map(np.array_equal, here, (betas, pose, trans)))

    def displacement(self, model: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, " V"]:
        """Of vertices, along the normals held here."""
        return ((model - self.model) * self.normal).sum(1)

    def offset_at(self, model: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, " V"]:
        """The offset h that is best for a surface of the model."""
        return self.mean + self.factor.solve(self.pull - self.lumped @ self.displacement(model))

    def cost(self, model: Float[np.ndarray, "V 3"]) -> float:
        """The least over all offsets."""
        displaced = self.displacement(model)
        lumped = self.lumped @ displaced
        pull = self.pull - lumped
        square = self.square + float(displaced @ lumped - 2.0 * displaced @ self.pull)
        return 0.5 * (square - float(pull @ self.factor.solve(pull)))

    def equations(
        self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N N"]]:
        """Gradient and Gauss-Newton matrix over betas, trans and pose."""
        if self._is_here(betas, pose, trans):
            jacobian = self.jacobian
        else:
            jacobian = surface_jacobian(self.body, betas, pose, trans)
        along = motion_along(self.normal, jacobian)
        displaced = self.displacement(self.model_at(betas, pose, trans))
        pull = self.pull - self.lumped @ displaced
        lumped = self.lumped @ along
        product = inverse_product(self.factor, np.column_stack([lumped, pull]))
        return product[:-1, -1] - along.T @ pull, along.T @ lumped - product[:-1, :-1]


def offset_term(scans: Sequence[OffsetEquations]) -> Term:
    """The term "offset" of all scans, over betas, trans and pose."""

    def residual(betas: np.ndarray, pose: np.ndarray, trans: np.ndarray) -> Quadratic:
        each = list(zip(scans, pose, trans, strict=True))
        cost = sum(scan.cost(scan.model_at(betas, *place)) for scan, *place in each)

        def derivatives() -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
            equations = [scan.equations(betas, *place) for scan, *place in each]
            return by_unknown(scans[0].body, equations)

        return Quadratic(cost, derivatives)

    return Term(residual, name="offset")
