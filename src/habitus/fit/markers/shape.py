"""The shape stage: betas, latent markers and the poses of a few frames (MoSh sec. 6, "Body Shape
and Latent Markers"); and its result, a subject: a person whose shape and marker placements are
known, so that motion can be fitted.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.energy import Placement, shape_terms
from habitus.fit.markers.settings import MoshSettings
from habitus.markers.layouts import MarkerLayout
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.marker_prediction import MarkedBody, marked_body
from habitus.observe.markers import MarkerAttachment, attach, default_markers
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import minimize
from habitus.solve.terms import geman_mcclure_weight

HOPELESS = "hopeless"
"""Status of a shape stage that ended early: the markers are no person's, by these labels or in this
unit of length."""


@dataclass(frozen=True)
class ShapeFit:
    """Result of the shape stage: betas, latent markers (m, in the body's rest space) and where they
    are attached, poses (rad) and places (m) of its F frames, costs by term, and how it ended.
    """

    betas: Float[np.ndarray, " B"]
    latent_markers: Float[np.ndarray, "M 3"]
    attachment: MarkerAttachment
    pose: Float[np.ndarray, "F J 3"]
    trans: Float[np.ndarray, "F 3"]
    costs: dict[str, float]
    status: str
    iterations: int


@dataclass(frozen=True, eq=False)
class Subject:
    """The result of the shape stage, found once for a person and valid for all captures.

    prior: of the body's joints. layout: the M markers in use, with the shape stage's ``shape``.
    exchanged: pairs of markers (columns) whose labels are swapped throughout. misplaced: markers
    (columns) too far from the layout's places to be the ones meant; they get no weight. seconds:
    that the shape stage took. sources: the recordings, by number, whose frames it used.
    """

    body: BodyModel
    prior: PosePrior
    layout: MarkerLayout
    shape: ShapeFit
    exchanged: tuple[tuple[int, int], ...] = ()
    misplaced: tuple[int, ...] = ()
    seconds: float = 0.0
    sources: tuple[int, ...] = (0,)

    @property
    def betas(self) -> Float[np.ndarray, " B"]:
        """Shape coefficients (B,)."""
        return self.shape.betas

    @property
    def hopeless(self) -> bool:
        """Whether the shape stage ended early, so that no sound fit follows."""
        return self.shape.status == HOPELESS

    @cached_property
    def rig(self) -> MarkedBody:
        """The body of this shape with its markers attached."""
        return marked_body(self.body, self.shape.betas, self.shape.attachment)

    def displaced(self) -> Float[np.ndarray, " M"]:
        """Distances of latent markers from the layout's places, in the layout's spreads."""
        vertices = self.layout.vertices(self.body)
        places = default_markers(self.body, self.shape.betas, vertices, self.layout.distances())
        distance = np.linalg.norm(self.shape.latent_markers - places, axis=1)
        return distance / self.layout.place_spreads()


def shape_stage(
    body: BodyModel,
    placement: Placement,
    observed: np.ndarray,
    prior: PosePrior,
    pose: np.ndarray,
    trans: np.ndarray,
    settings: MoshSettings,
) -> ShapeFit:
    """Betas, latent markers and poses from F frames, the priors' weights annealed (MoSh sec. 6).

    observed (F, M, 3), NaN where missing; prior for the body's joints; pose (F, J, 3) and trans (F,
    3) to start from. The closest triangle of each latent marker and its local basis are found again
    as the solve goes.
    """
    betas = np.zeros(body.num_betas)
    latent = default_markers(body, betas, placement.vertices, placement.distance)
    unknowns = {"betas": betas, "latent_markers": latent, "pose": pose, "trans": trans}
    visible = np.isfinite(observed[..., 0]).astype(float)
    filled = np.nan_to_num(observed)
    iterations = 0
    status = ""
    settled = False
    costs: dict[str, float] = {}
    last = len(settings.annealing) - 1
    for step in [*range(last), *([last] * settings.last_repeats)]:
        markers = LatentMarkers(body, _attached(body, unknowns).triangles)
        residual = markers(**unknowns) - filled
        off = _median_distance(residual, visible)
        lost = step == settings.hopeless_step and off > settings.hopeless
        if lost or (step >= settings.hopeless_step and _stature(body, unknowns) > settings.tallest):
            status = HOPELESS
            break
        rough = off > settings.rough
        if step == last and rough and settled:
            break
        settled = step == last
        weights = visible * _robust_weights(residual, step, settings)
        terms = shape_terms(
            body, markers, placement, filled, weights, prior, settings, settings.annealing[step]
        )
        result = minimize(
            terms,
            unknowns,
            "dogleg",
            blocks=("trans", "pose"),
            max_iterations=settings.shape_iterations,
            tolerances=Tolerances(cost=settings.shape_tolerances[step == last and not rough]),
            stretch=False,
        )
        unknowns = result.values
        costs = result.costs
        status = result.status
        iterations = iterations + result.iterations
    return ShapeFit(
        **unknowns,
        attachment=_attached(body, unknowns),
        costs=costs,
        status=status,
        iterations=iterations,
    )


def _attached(body: BodyModel, unknowns: dict[str, np.ndarray]) -> MarkerAttachment:
    return attach(unknowns["latent_markers"], body.rest_vertices(unknowns["betas"]), body.faces)


def _stature(body: BodyModel, unknowns: dict[str, np.ndarray]) -> float:
    """Height (m) in the rest pose."""
    return float(np.ptp(body.rest_vertices(unknowns["betas"])[:, 1]))


def _median_distance(residual: np.ndarray, visible: np.ndarray) -> float:
    """Of the markers that are seen from where they are expected (m)."""
    return float(np.median(np.linalg.norm(residual, axis=2)[visible > 0]))


def _robust_weights(residual: np.ndarray, step: int, settings: MoshSettings) -> np.ndarray:
    """Geman-McClure weights (F, M) of the residuals so far; 1 at step 0, then with the scale
    max(robust_scale[1], shape_scale / step).
    """
    if step == 0:
        return np.ones(residual.shape[:2])
    scale = max(settings.robust_scale[1], settings.shape_scale / step)
    return geman_mcclure_weight(np.linalg.norm(residual, axis=2), scale)
