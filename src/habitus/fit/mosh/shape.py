"""The shape stage: betas, latent markers and the poses of a few frames (MoSh 6, "Body Shape and Latent Markers")."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.mosh.equations import arrow_equations
from habitus.fit.mosh.settings import MoshSettings
from habitus.observe.marker_prediction import linearize, marker_bases, predict
from habitus.observe.marker_rig import marker_rig
from habitus.observe.markers import MarkerAttachment, attach
from habitus.observe.rest import RestShape
from habitus.residuals import shape_stage as terms
from habitus.residuals.blocks import Block, costs_by_name
from habitus.residuals.robust import geman_mcclure_weight
from habitus.solve.arrow import ArrowMatrix
from habitus.solve.dogleg import dogleg_normal
from habitus.solve.least_squares import Tolerances


@dataclass(frozen=True)
class Placement:
    """What a layout says of M markers: template vertex (M,), distance from skin and the two spreads (M,), metres."""

    vertices: np.ndarray
    distance: np.ndarray
    distance_spread: np.ndarray
    place_spread: np.ndarray


@dataclass(frozen=True)
class ShapeFit:
    """Result of the shape stage: betas (B,), latent_markers (M, 3), pose (F, J, 3), trans (F, 3) and how it ended."""

    betas: np.ndarray
    latent_markers: np.ndarray
    attachment: MarkerAttachment
    pose: np.ndarray
    trans: np.ndarray
    costs: dict[str, float]
    status: str
    iterations: int


@dataclass(frozen=True)
class _Stage:
    """One annealing step: everything that stays while the unknowns move."""

    body: BodyModel
    rest: RestShape
    placement: Placement
    observed: np.ndarray
    weights: np.ndarray
    prior: PosePrior
    settings: MoshSettings
    attachment: MarkerAttachment
    scale: float
    columns: terms.Columns


def shape_stage(
    body: BodyModel,
    placement: Placement,
    observed: np.ndarray,
    prior: PosePrior,
    pose: np.ndarray,
    trans: np.ndarray,
    settings: MoshSettings,
) -> ShapeFit:
    """Betas, latent markers and poses from F frames.

    observed (F, M, 3), NaN where missing; prior for the body's joints; pose (F, J, 3) and trans (F, 3) to start from.
    The closest triangle of each latent marker and its local basis are found again as the solve goes.
    """
    rest = RestShape(body)
    columns = terms.Columns(rest.num_betas, len(placement.vertices), len(observed), body.num_joints)
    betas = np.zeros(rest.num_betas)
    x = columns.pack(betas, rest.default_markers(betas, placement.vertices, placement.distance)[0], pose, trans)
    visible = np.isfinite(observed[..., 0]).astype(float)
    filled, iterations, status = np.nan_to_num(observed), 0, ""
    for step, scale in enumerate(settings.annealing):
        last = step == len(settings.annealing) - 1
        for _ in range(3 if last else 1):
            betas, latent, pose, trans = columns.unpack(x)
            attachment = attach(latent, rest.vertices(betas), rest.faces)
            weights = visible * _robust_weights(body, betas, attachment, pose, trans, filled, visible, step, settings)
            stage = _Stage(body, rest, placement, filled, weights, prior, settings, attachment, scale, columns)
            tolerances = Tolerances(cost=1e-4 if last else 1e-3)
            result = dogleg_normal(partial(_equations, stage), x, max_iterations=15, tolerances=tolerances)
            x, status, iterations = result.x, result.status, iterations + result.iterations
    betas, latent, pose, trans = columns.unpack(x)
    attachment = attach(latent, rest.vertices(betas), rest.faces)
    return ShapeFit(betas, latent, attachment, pose, trans, costs_by_name(_blocks(stage, x)), status, iterations)


def _equations(stage: _Stage, x: np.ndarray) -> tuple[float, np.ndarray, ArrowMatrix]:
    columns = stage.columns
    return arrow_equations(_blocks(stage, x), columns.latent_markers.stop, columns.num_frames, columns.frame_size)


def _blocks(stage: _Stage, x: np.ndarray) -> list[Block]:
    """The objective of the stage (eq. 9), linearised at x."""
    lam, rest, place, columns = stage.settings.shape, stage.rest, stage.placement, stage.columns
    betas, latent, pose, trans = columns.unpack(x)
    vertices = rest.vertices(betas)
    start, start_by_betas = rest.default_markers(betas, place.vertices, place.distance)
    simulated = simulate(stage.body, betas, latent, stage.attachment.triangles, vertices, pose, trans)
    return [
        *terms.data(simulated, stage.observed, stage.weights, lam.data, columns),
        *terms.surface_distance(
            latent, vertices, rest.shapedirs, rest.faces, place.distance, place.distance_spread, lam.surface, columns
        ),
        *terms.start_place(latent, start, start_by_betas, place.place_spread, stage.scale * lam.start, columns),
        *terms.shape_prior(betas, stage.scale * lam.betas, columns),
        *terms.pose_prior(pose, stage.prior.mean, stage.prior.whitening, stage.scale * lam.pose, columns),
    ]


def simulate(
    body: BodyModel,
    betas: np.ndarray,
    latent: np.ndarray,
    triangles: np.ndarray,
    rest_vertices: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
) -> terms.Simulated:
    """Simulated markers of latent ones (MoSh eq. 2); derivatives hold latent markers, not coefficients, fixed.

    With x = a + R c and c = R0ᵀ(m - a0): dx/dm = R R0ᵀ and dx/dbetas = ∂x/∂betas|c - R R0ᵀ ∂m/∂betas|c.
    """
    rig = marker_rig(body, betas, attach(latent, rest_vertices, np.empty((0, 3)), triangles=triangles))
    still, origin = np.zeros((1, *pose.shape[1:])), np.zeros((1, 3))
    markers, jacobian = linearize(rig, pose, trans, np.zeros((len(pose), len(betas))))
    _, rest_jacobian = linearize(rig, still, origin, np.zeros((1, len(betas))))
    by_latent = marker_bases(rig, pose, trans) @ np.swapaxes(marker_bases(rig, still, origin), -1, -2)
    size = 3 + 3 * body.num_joints
    by_betas = jacobian[..., size:] - by_latent @ rest_jacobian[..., size:]
    return terms.Simulated(markers, jacobian[..., :size], by_betas, by_latent)


def _robust_weights(body, betas, attachment, pose, trans, observed, visible, step, settings) -> np.ndarray:
    """Geman-McClure weights (F, M) of the residuals so far, wide at first; the first step trusts every marker."""
    if step == 0:
        return np.ones(visible.shape)
    markers = predict(marker_rig(body, betas, attachment), pose, trans)
    distance = np.linalg.norm(markers - observed, axis=2)
    scale = max(settings.robust_scale[1], 0.3 / step)
    return geman_mcclure_weight(distance, np.full(visible.shape[1], scale))
