"""Tape, calipers and scales on some points: values of many bodies at once, and their gradients.

Every gauge maps points (N, p, 3) to values (N,) and gradients (N, p, 3), metres or kilograms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

TAPE_DIRECTIONS = 48


class Gauge(Protocol):
    """One measurement."""

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (N,) and gradients (N, p, 3)."""
        ...


@dataclass(frozen=True)
class Linear:
    """A fixed linear function: sum of weights (p, 3) times points, plus a constant."""

    weights: np.ndarray
    add: float = 0.0

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Gauge."""
        value = np.einsum("npc,pc->n", points, self.weights) + self.add
        return value, np.broadcast_to(self.weights, points.shape)


@dataclass(frozen=True)
class AboveSole:
    """Height of the first point above the lowest of the others."""

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Gauge."""
        low = 1 + points[:, 1:, 1].argmin(1)
        each = np.arange(len(points))
        slope = np.zeros(points.shape)
        slope[:, 0, 1] = 1
        slope[each, low, 1] = -1
        return points[:, 0, 1] - points[each, low, 1], slope


@dataclass(frozen=True)
class Distance:
    """Straight from the first point to the second."""

    add: float = 0.0

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Gauge."""
        gap = points[:, 0] - points[:, 1]
        length = np.linalg.norm(gap, axis=1)
        unit = gap / length[:, None]
        return length + self.add, np.stack([unit, -unit], 1)


@dataclass(frozen=True)
class Extent:
    """Calipers: largest less smallest coordinate along `axis` (3,); `twice`: of a symmetric body
    whose left half is given, twice the largest.
    """

    axis: np.ndarray
    twice: bool = False

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Gauge."""
        along = points @ self.axis
        each = np.arange(len(points))
        slope = np.zeros(points.shape)
        top = along.argmax(1)
        low = along.argmin(1)
        if self.twice:
            slope[each, top] = 2 * self.axis
            return 2 * along[each, top], slope
        slope[each, top] = self.axis
        slope[each, low] -= self.axis
        return along[each, top] - along[each, low], slope


@dataclass(frozen=True)
class Tape:
    """Perimeter of the points' convex hull in the plane of `basis` (2, 3): the support function's
    integral (Cauchy).
    """

    basis: np.ndarray
    add: float = 0.0

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Gauge."""
        angle = np.arange(TAPE_DIRECTIONS) * 2 * np.pi / TAPE_DIRECTIONS
        towards = np.stack([np.cos(angle), np.sin(angle)], 1) @ self.basis  # (D, 3)
        along = points @ towards.T
        far = along.argmax(1)  # (N, D)
        step = 2 * np.pi / TAPE_DIRECTIONS
        share = (far[:, :, None] == np.arange(points.shape[1])).transpose(0, 2, 1)  # (N, p, D)
        slope = (share.reshape(-1, TAPE_DIRECTIONS) @ (step * towards)).reshape(points.shape)
        return np.take_along_axis(along, far[:, None], 1)[:, 0].sum(1) * step + self.add, slope


@dataclass(frozen=True)
class Scales:
    """Weight from the volume of a symmetric body whose left half's triangles (F, 3) are given, open
    on the midline.

    The missing cap lies in the plane x = 0, through the origin of the cones that are summed: it
    adds nothing.
    """

    triangles: np.ndarray
    density: float

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Gauge."""
        a, b, c = (points.astype(np.float32)[:, self.triangles[:, k]] for k in range(3))
        normals = np.concatenate([_cross(b, c), _cross(c, a), _cross(a, b)], 1)
        value = np.einsum("nfc,nfc->n", a, normals[:, : a.shape[1]], dtype=np.float64) / 6
        corner = self.triangles.T.ravel()
        order = np.argsort(corner, kind="stable")
        starts = np.searchsorted(corner[order], np.arange(points.shape[1]))
        slope = np.add.reduceat(normals[:, order], starts, axis=1) / 6
        return 2 * self.density * value, 2 * self.density * slope


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(a, -1, 0)
    u, v, w = np.moveaxis(b, -1, 0)
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)
