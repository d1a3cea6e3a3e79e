"""Random numbers of unit variance with given skewness."""

import numpy as np
from jaxtyping import Float


def skewed(
    normal: Float[np.ndarray, "*batch B"], skewness: Float[np.ndarray, " B"]
) -> Float[np.ndarray, "*batch B"]:
    """Standard normal numbers by a monotone map with mean 0, variance 1 and this skewness: a
    shifted log-normal distribution (mirrored where it is negative), the normal one at 0.
    """
    g2 = np.asarray(skewness, float) ** 2
    root = np.cbrt(1 + g2 / 2 + np.sqrt(g2 * (1 + g2 / 4)))
    width = np.sqrt(np.log(root + 1 / root - 1))  # of the logarithm
    sign = np.where(np.asarray(skewness) < 0, -1.0, 1.0)
    some = width > 1e-4
    scale = np.where(some, width, 1.0)
    drawn = np.expm1(scale * sign * normal - scale**2 / 2) / np.sqrt(np.expm1(scale**2))
    return np.where(some, sign * drawn, normal)
