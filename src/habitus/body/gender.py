"""How likely a shape is a woman's: the body's classifier (M 8.3), no surer than the shape itself is
known.
"""

import math

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel

UNDECIDED = "undecided"
SURE = 0.8
"""Less than this, of either sex, says nothing."""
BETA_ERROR = 0.5
"""Standard deviation of a coefficient's error where none is given."""


def female_probability(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    covariance: Float[np.ndarray, "B B"] | float = BETA_ERROR,
) -> float | None:
    """P(female) of a shape whose coefficients are known to a covariance, or to so much each; None
    without a classifier.

    The classifier's score is the log odds of a woman where the betas are known; over their spread
    the mean of its sigmoid is sigmoid(s / sqrt(1 + pi/8 var s)) (MacKay 1992).
    """
    if body.female_direction is None:
        return None
    weights, bias = body.female_direction
    spread = (
        covariance**2 * np.eye(len(weights)) if np.ndim(covariance) == 0 else np.asarray(covariance)
    )
    score = float(weights @ betas) + bias
    variance = float(weights @ spread @ weights)
    logit = float(np.clip(score / math.sqrt(1.0 + math.pi / 8.0 * variance), -500.0, 500.0))
    return 1.0 / (1.0 + math.exp(-logit))


def said_of(probability: float) -> str:
    """ "female" or "male" where it is sure enough, else "undecided"."""
    if probability > SURE:
        return "female"
    return "male" if probability < 1.0 - SURE else UNDECIDED
