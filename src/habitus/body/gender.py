"""How likely a shape is a woman's: the body's classifier, as sure as real people and the shape's own error allow.

The classifier learned from the body's own women and men, who differ more clearly than real ones. The line that brings
its score to the odds among measured people was learned from a survey by ``benchmarks/gender_calibration.py``.
"""

import math

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel

SURVEY_SLOPE, SURVEY_OFFSET = 0.765, 0.257
BETA_ERROR = 0.5
"""Standard deviation of a coefficient's error after a fit to markers, about."""


def female_probability(body: BodyModel, betas: Float[np.ndarray, " B"], error: float = BETA_ERROR) -> float | None:
    """P(female) of a shape whose coefficients are known to ``error`` each; None for a body without the classifier.

    The mean of the sigmoid over that error: sigmoid(s / sqrt(1 + pi/8 var s)) for a score s (MacKay 1992).
    """
    if body.female_direction is None:
        return None
    weights, bias = body.female_direction
    score = SURVEY_SLOPE * (float(weights @ betas) + bias) + SURVEY_OFFSET
    spread = (SURVEY_SLOPE * error) ** 2 * float(weights @ weights)
    logit = float(np.clip(score / math.sqrt(1.0 + math.pi / 8.0 * spread), -500.0, 500.0))
    return 1.0 / (1.0 + math.exp(-logit))
