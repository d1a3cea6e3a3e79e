"""Gaussian priors over shape and pose, as terms with their own normal equations (T 4.6.1, 5.4).

"shape"  1/2 (betas - b)^T P (betas - b)
"pose"   1/2 sum_t (theta_t - m_t)^T P (theta_t - m_t)          theta_t: pose (J, 3) of scan or view t
"""  # noqa: E501

import numpy as np
from jaxtyping import Float

from habitus.solve.terms import Quadratic, Term


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
