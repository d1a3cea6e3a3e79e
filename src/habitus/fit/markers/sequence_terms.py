"""The energy of the pose and soft-tissue stages as a dictionary of terms (M equations 3, 7, 8 and
10).

This is the statement; `habitus.fit.markers.sequence` minimises it by fused kernels
(`residuals/marker_kernels.py`, `sequence_kernels.py`), which tests hold to these terms. The causal
mode minimises the same of three frames, the first two held.
"""

import numpy as np
import scipy.sparse
from jaxtyping import Float

from habitus.body.prior import PosePrior
from habitus.fit.markers.settings import SequenceSettings
from habitus.observe.body_markers import BodyMarkers
from habitus.residuals.shape_stage import diagonal
from habitus.solve.terms import GemanMcClure, Term


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
    stencil = scipy.sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=shape)
    return np.diff(flat, 2, axis=0), {
        name: scipy.sparse.kron(stencil, scipy.sparse.eye_array(flat.shape[1]))
    }


def _itself(name: str, values: Float[np.ndarray, "T n"]) -> tuple[np.ndarray, dict]:
    return values, {name: scipy.sparse.eye_array(values.size)}
