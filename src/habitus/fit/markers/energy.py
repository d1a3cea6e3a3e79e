"""The energies of the marker fit as dictionaries of terms: every term with its equation, weight and
source.

Shape stage, over betas, latent markers and poses of a few frames (`shape_terms`, M eq. 9, T eq.
3.9); the weights of E_I, E_beta and E_theta are annealed (`MoshSettings.annealing`):

    term      E        equation          weight               what it asks
    data      E_D      M 3, T 3.3        ShapeWeights.data    predicted markers at the observed ones
    surface   E_S      M 4, T 3.4        .surface             latent markers as far from the skin
                                                              as the layout says
    start     E_I      M 5, T 3.5        .start               latent markers at the layout's places
    betas     E_beta   M 6, T 3.6        .betas               likely shapes
    pose      E_theta  M 7, T 3.7        .pose                likely poses

Pose stage and, with soft tissue, soft-tissue stage, over all frames (`sequence_terms`, M eqs. 9 and
10, T eqs. 3.9 and 3.10):

    data      E_D      M 3, T 3.3        PoseWeights.data     predicted markers at the observed ones
    pose      E_theta  M 7, T 3.7        .pose                likely poses
    acceleration  E_u  M 8, T 3.8        .acceleration        constant velocity from frame to frame
    soft_tissue E_Delta  M 10, T 3.10    .soft_tissue         small changes of shape

The paper states weights per cm^2; `habitus.residuals.shape_stage.PER_CM2` converts them, once. The
data terms are robust (Geman-McClure, T section 3.6).
`habitus.fit.markers.sequence` minimises the second
energy by fused kernels (`residuals/marker_kernels.py`, `sequence_kernels.py`), which tests hold to
these terms; the causal mode minimises the same of three frames, the first two held.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.settings import MoshSettings, SequenceSettings
from habitus.markers.layouts import MarkerLayout
from habitus.observe.body_markers import BodyMarkers
from habitus.observe.latent_markers import LatentMarkers
from habitus.residuals import shape_stage as shape_energy
from habitus.residuals.shape_stage import diagonal
from habitus.solve.terms import GemanMcClure, Term


@dataclass(frozen=True)
class Placement:
    """What a layout says of M markers: template vertex (M,), distance from skin and the two spreads
    (M,), metres.
    """

    vertices: Int[np.ndarray, " M"]
    distance: Float[np.ndarray, " M"]
    distance_spread: Float[np.ndarray, " M"]
    place_spread: Float[np.ndarray, " M"]


def place(layout: MarkerLayout, body: BodyModel) -> Placement:
    """The layout's markers on this body's template."""
    return Placement(
        layout.vertices(body), layout.distances(), layout.distance_spreads(), layout.place_spreads()
    )


def shape_terms(
    body: BodyModel,
    markers: LatentMarkers,
    placement: Placement,
    observed: np.ndarray,
    weights: np.ndarray,
    prior: PosePrior,
    settings: MoshSettings,
    prior_scale: float,
) -> dict[str, Term]:
    """The energy of the shape stage (eq. 9): observed (F, M, 3) without NaN, weights (F, M), 0
    where missing.
    """
    lam = settings.shape
    place = placement
    return {
        "data": shape_energy.data(markers, observed, weights, lam.data),
        "surface": shape_energy.surface_distance(
            body, place.distance, place.distance_spread, lam.surface
        ),
        "start": shape_energy.start_place(
            body, place.vertices, place.distance, place.place_spread, prior_scale * lam.start
        ),
        "betas": shape_energy.shape_prior(body.num_betas, prior_scale * lam.betas),
        "pose": shape_energy.pose_prior(
            prior.mean, prior.whitening, len(observed), prior_scale * lam.pose
        ),
    }


def sequence_terms(
    marked: BodyMarkers,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    prior: PosePrior,
    settings: SequenceSettings,
) -> dict[str, Term]:
    """Terms of pose (T, J, 3) rad, trans (T, 3) m and soft_tissue (T, B), with Jacobians; arguments
    as `fit_sequence`.

    data: E_D with Geman-McClure's loss; pose: E_theta; acceleration and trans_acceleration: E_u;
    soft_tissue: E_Delta and soft_tissue_acceleration. Roots that pass 1.5 pi, where the solver
    changes charts, are not looked after.
    """
    return {
        "data": data(marked, observed, weights, scales, settings.data),
        "pose": pose_prior(prior, len(observed), settings.pose),
        "acceleration": Term(lambda pose: _bending("pose", pose), settings.acceleration),
        "trans_acceleration": Term(
            lambda trans: _bending("trans", trans),
            settings.trans_acceleration if settings.acceleration else 0.0,
        ),
        "soft_tissue": Term(
            lambda soft_tissue: _itself("soft_tissue", soft_tissue), settings.soft_tissue
        ),
        "soft_tissue_acceleration": Term(
            lambda soft_tissue: _bending("soft_tissue", soft_tissue),
            settings.soft_tissue_acceleration if settings.acceleration else 0.0,
        ),
    }


def data(
    marked: BodyMarkers,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    weight: float,
) -> Term:
    """E_D: 1/2 weight sum w rho(|x - m|^2), gaps (NaN) at w = 0.

    The roots of w scale the residual, so they scale the loss as well: rho_s'(w d^2) = w rho_s(d^2)
    with s' = s sqrt(w).
    """
    seen = np.isfinite(observed).all(axis=2)
    given = np.where(seen, 1.0 if weights is None else weights, 0.0)
    root = np.sqrt(given)[..., None]
    filled = np.nan_to_num(observed)
    frames = len(observed)
    wide = np.full(observed.shape[1], np.inf) if scales is None else np.asarray(scales, dtype=float)
    robust = GemanMcClure(
        np.where(given > 0.0, wide * np.where(given > 0.0, root[..., 0], 1.0), np.inf)
    )

    def residual(pose, trans, soft_tissue):
        def jacobians():
            found = marked.jacobian(pose, trans, soft_tissue)
            by = {"pose": found.by_pose, "trans": np.eye(3), "soft_tissue": found.by_betas}
            rows = 3 * observed.shape[1]
            return {
                name: diagonal((root[..., None] * each).reshape(frames, rows, -1))
                for name, each in by.items()
            }

        return root * (marked.predict(pose, trans, soft_tissue) - filled), jacobians

    return Term(residual, weight, robust)


def pose_prior(prior: PosePrior, frames: int, weight: float) -> Term:
    """E_theta: 1/2 weight (theta - mu)^T P (theta - mu); the root is free."""
    root = np.linalg.cholesky(prior.precision).T
    block = np.concatenate([np.zeros((len(root), 3)), root], axis=1)
    by_pose = diagonal(np.tile(block, (frames, 1, 1)))

    def residual(pose):
        return (pose[:, 1:].reshape(frames, -1) - prior.mean) @ root.T, {"pose": by_pose}

    return Term(residual, weight)


def _bending(name: str, values: Float[np.ndarray, "T *n"]) -> tuple[np.ndarray, dict]:
    """Second differences x_t - 2 x_{t-1} + x_{t-2}, and their Jacobian."""
    flat = values.reshape(len(values), -1)
    shape = (len(flat) - 2, len(flat))
    stencil = scipy.sparse.diags_array(
        [1.0, -2.0, 1.0],
        offsets=[0, 1, 2],  # pyright: ignore[reportArgumentType]  (SciPy has no annotations)
        shape=shape,
    )
    return np.diff(flat, 2, axis=0), {
        name: scipy.sparse.kron(stencil, scipy.sparse.eye_array(flat.shape[1]))
    }


def _itself(name: str, values: Float[np.ndarray, "T n"]) -> tuple[np.ndarray, dict]:
    return values, {name: scipy.sparse.eye_array(values.size)}
