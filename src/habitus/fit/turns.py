"""Rotation vectors of a root that turns and turns: theta and theta + 2 pi k along its axis are the same rotation."""

import numpy as np
from jaxtyping import Bool, Float

from habitus.compiled import compiled

LONGEST_TURN = 1.5 * np.pi
"""A longer root rotation vector (rad) gives way to its shorter twin: the chart is singular at 2 pi."""


def nearest_twin(vectors: Float[np.ndarray, "*F 3"], reference: Float[np.ndarray, "*F 3"]) -> Float[np.ndarray, "*F 3"]:
    """The same rotations by the vectors (theta + 2 pi k along their axes) closest to `reference`."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = np.where(angle > 1e-12, vectors / np.maximum(angle, 1e-300), 0.0)
    turns = np.round((np.sum(axis * reference, axis=-1, keepdims=True) - angle) / (2.0 * np.pi))
    return vectors + 2.0 * np.pi * turns * axis


def unwrap(vectors: Float[np.ndarray, "T 3"]) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
    """Rotation vectors that follow each other, and where (T,) they jump to a shorter twin past `LONGEST_TURN`."""
    out, jumps = np.array(vectors, dtype=float), np.zeros(len(vectors), dtype=bool)
    _unwrap(out, jumps)
    return out, jumps


@compiled
def _unwrap(out, jumps):
    for t in range(len(out)):
        angle = np.sqrt(np.sum(out[t] ** 2))
        if angle > 1e-12:
            along = np.sum(out[t] * out[t - 1]) / angle if t > 0 else angle
            out[t] *= (angle + 2.0 * np.pi * np.round((along - angle) / (2.0 * np.pi))) / angle
        angle = np.sqrt(np.sum(out[t] ** 2))
        if angle > LONGEST_TURN:
            out[t] *= (angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))) / angle
            jumps[t] = t > 0
