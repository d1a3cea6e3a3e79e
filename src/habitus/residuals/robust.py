"""Robust losses, as weights of iteratively re-weighted least squares."""

import numpy as np


def geman_mcclure_weight(distance: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    """Weight in 0..1 of a residual of length ``distance``: (s² / (s² + d²))², the loss being s² d²
    / (s² + d²).
    """
    return (1.0 / (1.0 + np.square(distance / scale))) ** 2
