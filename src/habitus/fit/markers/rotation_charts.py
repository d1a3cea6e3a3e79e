"""Rotation vectors of a root that turns and turns: theta and theta + 2 pi k along its axis are the
same rotation.
"""

import math

import numpy as np
from jaxtyping import Bool, Float

from habitus.kernels.jit import jit

LONGEST_TURN = 1.5 * np.pi
"""A longer root rotation vector (rad) gives way to its shorter equivalent: the chart is singular at
2 pi.
"""
WHOLE = 2.0 * np.pi


def nearest_equivalent(
    vectors: Float[np.ndarray, "*F 3"], reference: Float[np.ndarray, "*F 3"]
) -> Float[np.ndarray, "*F 3"]:
    """The same rotations by the vectors (theta + 2 pi k along their axes) closest to
    `reference`.
    """
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = np.where(angle > 1e-12, vectors / np.maximum(angle, 1e-300), 0.0)
    turns = np.round((np.sum(axis * reference, axis=-1, keepdims=True) - angle) / WHOLE)
    return vectors + WHOLE * turns * axis


def shortened(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The same rotation by its shortest vector if this one passes `LONGEST_TURN`."""
    angle = math.sqrt(vector @ vector)
    return (
        vector if angle <= LONGEST_TURN else vector * (1.0 - WHOLE * round(angle / WHOLE) / angle)
    )


def unwrap(
    vectors: Float[np.ndarray, "T 3"],
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
    """Rotation vectors that follow each other, and where (T,) they jump to a shorter equivalent
    past `LONGEST_TURN`.
    """
    out = np.array(vectors, dtype=float)
    jumps = np.zeros(len(vectors), dtype=bool)
    _unwrap(out, jumps)
    return out, jumps


@jit
def _unwrap(out, jumps):
    for t in range(len(out)):
        x = out[t, 0]
        y = out[t, 1]
        z = out[t, 2]
        angle = math.sqrt(x * x + y * y + z * z)
        if angle > 1e-12:
            along = (
                (x * out[t - 1, 0] + y * out[t - 1, 1] + z * out[t - 1, 2]) / angle
                if t > 0
                else angle
            )
            longer = angle + WHOLE * math.floor((along - angle) / WHOLE + 0.5)
            if abs(longer) > LONGEST_TURN:
                longer -= WHOLE * math.floor(longer / WHOLE + 0.5)
                jumps[t] = t > 0
            for k in range(3):
                out[t, k] *= longer / angle
