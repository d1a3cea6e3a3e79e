"""Choosing few points that represent many."""

import numpy as np
from jaxtyping import Float, Int


def farthest_points(
    points: Float[np.ndarray, "N C"], count: int, first: int = 0
) -> Int[np.ndarray, " K"]:
    """Farthest-point sampling: ``count`` rows of ``points`` (at most N), beginning with ``first``;
    each next one is the row farthest from all chosen before it.
    """
    chosen = [first]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(nearest.argmax()))
    return np.array(chosen, np.int64)
