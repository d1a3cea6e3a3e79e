"""Random betas of people: normal, but skewed along one direction."""

import numpy as np
from jaxtyping import Float


def skewed_along(
    normal: Float[np.ndarray, "N B"], direction: Float[np.ndarray, " B"]
) -> Float[np.ndarray, "N B"]:
    """Standard normal rows with their part along ``direction`` skewed, which has zero mean and unit
    variance as before; the direction's length is the skewness.
    """
    skewness = float(np.linalg.norm(direction))
    if skewness == 0:
        return normal
    unit = np.asarray(direction, float) / skewness
    along = normal @ unit
    return normal + (skewed(along, skewness) - along)[:, None] * unit


def skewed(normal: Float[np.ndarray, "*batch"], skewness: float) -> Float[np.ndarray, "*batch"]:
    """Standard normal numbers by a monotone map with mean 0, variance 1 and this skewness, which is
    at least 0: a shifted log-normal distribution, the normal one at 0.
    """
    square = skewness**2
    root = np.cbrt(1 + square / 2 + np.sqrt(square * (1 + square / 4)))
    width = np.sqrt(np.log(root + 1 / root - 1))  # of the logarithm
    if width < 1e-4:
        return normal
    return np.expm1(width * normal - width**2 / 2) / np.sqrt(np.expm1(width**2))
