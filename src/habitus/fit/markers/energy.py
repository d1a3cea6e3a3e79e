"""The energies of the marker fit: every term with its equation, source and weight.

Sources: "MoSh" is Loper, Mahmood, Black, *MoSh: Motion and Shape Capture from Sparse Markers* (ACM
Transactions on Graphics 33(6), 2014); "thesis" is Loper's PhD thesis (University of Tuebingen,
2017); "SMPL" is Loper, Mahmood, Romero, Pons-Moll, Black, *SMPL: A Skinned Multi-Person Linear
Model* (ACM Transactions on Graphics 34(6), 2015). All of `habitus.fit.markers` cites them so.

A term costs 1/2 weight |residual|^2, summed over all its rows; lengths are metres, angles radians.
The papers state weights per cm^2, and so do `ShapeWeights`, `PoseWeights` and `MoshWeights`;
`habitus.residuals.shape_stage.per_m2` converts them (0.75 per cm^2 = 7500 per m^2).

Shape stage (`shape_terms`; MoSh eq. 9, thesis eq. 3.9), over betas, latent markers and the poses of
a few frames. Weights are fields of `ShapeWeights`; a is the step of `MoshSettings.annealing`:

    term     symbol   MoSh   thesis    default     effective weight          residual
    data     E_D      eq. 3  eq. 3.3   0.75/cm^2   7500/m^2 w                predicted - observed
                                                                             marker, each frame
    surface  E_S      eq. 4  eq. 3.4   100/cm^2    1e6/m^2 (1 mm/spread)^2   distance of latent
                                                                             marker - layout's
    start    E_I      eq. 5  eq. 3.5   0.25/cm^2   a 2500/m^2 (2 cm/spr.)^2  latent marker - its
                                                                             place in the layout
    betas    E_beta   eq. 6  eq. 3.6   1           a                         betas
    pose     E_theta  eq. 7  eq. 3.7   0.25        a 0.25                    whitened pose - mean

"spread" is the layout's, of each marker (`Placement.distance_spread`, `.place_spread`); at the
papers' 1 mm and 2 cm the factor is 1. w is Geman-McClure's weight of the sample at the last state;
its scale is max(robust_scale[1], shape_scale / step), 1 throughout at step 0, 0 where the marker is
missing.

Pose stage and soft-tissue stage (`sequence_terms`; MoSh eqs. 9 and 10, thesis eqs. 3.9 and 3.10),
over all frames. Weights are fields of `SequenceSettings`; `sequence_settings` makes them of
`PoseWeights`:

    term                      symbol   MoSh    thesis    weight       residual
    data                      E_D      eq. 3   eq. 3.3   7500/m^2 w   predicted - observed marker,
                                                                      robust loss
    pose                      E_theta  eq. 7   eq. 3.7   1            whitened pose - mean, no root
    acceleration              E_u      eq. 8   eq. 3.8   6.25/rad^2   second difference of the pose
    trans_acceleration        -        -       -         10/m^2       second difference of trans
    soft_tissue               E_Delta  eq. 10  eq. 3.10  0.25         change of shape beta_t
    soft_tissue_acceleration  -        -       -         0 (off)      second difference of beta_t

w is the weight of the sample: 1 if observed, `GapSettings.weight` (0.25) if it stands in for a
missing one, 0 for misplaced markers. In both energies E_theta of finger joints is multiplied by
`FINGER_SHARE`. The loss is Geman-McClure's (thesis sec. 3.6) with the scale
clip(noise_factor x noise of the marker, *robust_scale); robust_scale[1] while the noise is unknown.
The two terms without a source are ours: the first carries trans over frames without markers, the
second can be set in `SequenceSettings` only. Second differences x_t - 2 x_{t-1} + x_{t-2} are not
divided by the frame interval, so what 6.25 means depends on the frame rate: at half the rate the
same motion costs 16 times as much a frame. acceleration = 0 switches all three of them off.

`habitus.fit.markers.sequence` minimises the second energy by fused kernels
(`residuals/marker_kernels.py`, `sequence_kernels.py`), which tests hold to these terms; the causal
mode minimises the same energy of three frames, the first two held.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from habitus.body.hand_space import hand_joints
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.settings import MoshSettings, SequenceSettings
from habitus.markers.layouts import MarkerLayout
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.marker_prediction import BodyMarkers
from habitus.residuals import shape_stage as shape_energy
from habitus.residuals.shape_stage import diagonal
from habitus.solve.terms import GemanMcClure, Term

FINGER_SHARE = 0.07
"""Of E_theta's weight, what finger joints take. E_D's weight allows for soft tissue, 11.5 mm of it
(1 / sqrt(7500 per m^2)); a finger has about 3 mm, and its joints move finger markers alone, so that
a prior of (3 / 11.5)^2 the weight does for them what weights of finger markers would, without
these pulling at the arm.
"""


def for_markers(prior: PosePrior) -> PosePrior:
    """The pose prior as E_theta takes it: finger joints at `FINGER_SHARE`."""
    fingers = np.isin(prior.joint_names, hand_joints())
    if not fingers.any():
        return prior
    root = np.where(fingers, FINGER_SHARE**-0.5, 1.0).repeat(3)
    return replace(prior, covariance=root[:, None] * prior.covariance * root)


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
    """The energy of the shape stage (MoSh eq. 9): observed (F, M, 3) without NaN, weights (F, M), 0
    where missing.
    """
    weight = settings.shape
    return {
        "data": shape_energy.data(markers, observed, weights, weight.data),
        "surface": shape_energy.surface_distance(
            body, placement.distance, placement.distance_spread, weight.surface
        ),
        "start": shape_energy.start_place(
            body,
            placement.vertices,
            placement.distance,
            placement.place_spread,
            prior_scale * weight.start,
        ),
        "betas": shape_energy.shape_prior(body.num_betas, prior_scale * weight.betas),
        "pose": shape_energy.pose_prior(
            prior.mean,
            for_markers(prior).whitening,
            len(observed),
            prior_scale * weight.pose,
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

    The terms are those of the module's second table. Unlike the solver, which changes charts there,
    `acceleration` does not unwrap roots that turn past 1.5 pi.
    """
    return {
        "data": data(marked, observed, weights, scales, settings.data),
        "pose": pose_prior(prior, len(observed), settings.pose),
        "acceleration": Term(lambda pose: _second_difference("pose", pose), settings.acceleration),
        "trans_acceleration": Term(
            lambda trans: _second_difference("trans", trans),
            settings.trans_acceleration if settings.acceleration else 0.0,
        ),
        "soft_tissue": Term(
            lambda soft_tissue: _identity("soft_tissue", soft_tissue), settings.soft_tissue
        ),
        "soft_tissue_acceleration": Term(
            lambda soft_tissue: _second_difference("soft_tissue", soft_tissue),
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
            jacobian = marked.jacobian(pose, trans, soft_tissue)
            by = {"pose": jacobian.by_pose, "trans": np.eye(3), "soft_tissue": jacobian.by_betas}
            rows = 3 * observed.shape[1]
            return {
                name: diagonal((root[..., None] * each).reshape(frames, rows, -1))
                for name, each in by.items()
            }

        return root * (marked.predict(pose, trans, soft_tissue) - filled), jacobians

    return Term(residual, weight, robust)


def pose_prior(prior: PosePrior, frames: int, weight: float) -> Term:
    """E_theta: 1/2 weight (theta - mu)^T P (theta - mu); the root is free."""
    root = np.linalg.cholesky(for_markers(prior).precision).T
    block = np.concatenate([np.zeros((len(root), 3)), root], axis=1)
    by_pose = diagonal(np.tile(block, (frames, 1, 1)))

    def residual(pose):
        return (pose[:, 1:].reshape(frames, -1) - prior.mean) @ root.T, {"pose": by_pose}

    return Term(residual, weight)


def _second_difference(name: str, values: Float[np.ndarray, " T *n"]) -> tuple[np.ndarray, dict]:
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


def _identity(name: str, values: Float[np.ndarray, "T n"]) -> tuple[np.ndarray, dict]:
    return values, {name: scipy.sparse.eye_array(values.size)}
