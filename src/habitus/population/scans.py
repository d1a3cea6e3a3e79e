"""Scans of people that a body model does not know: what a structured-light scanner would leave of a surface."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.fit.registration.scan import Scan
from habitus.mesh.normals import face_normals

PATCH = 0.05
"""Metres: radius of a hole."""
CELL, BEHIND = 0.004, 0.01
"""Metres: what a camera tells apart across, and how far behind the nearest surface it still sees in a cell."""
GRAZING = 0.15
"""Cosine of surface and line of sight below which a scanner sees nothing."""


@dataclass(frozen=True)
class Scanner:
    """How a scan is made: how many points, noise along every axis (m, sd), the share that holes take, and from where.

    ``sides`` are directions (unit, from the person to the camera) of which a point has to be seen from one; none:
    everything is seen.
    """

    points: int = 100_000
    noise: float = 0.0005
    holes: float = 0.08
    sides: Sequence[tuple[float, float, float]] = ()


def scanned(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    scanner: Scanner,
    rng: np.random.Generator,
    name: str = "scan",
) -> Scan:
    """A cloud of points (m) drawn evenly from a surface, with noise and holes, in no order and without normals."""
    normals = face_normals(vertices, faces)
    area = np.linalg.norm(normals, axis=1)
    face = rng.choice(len(faces), int(scanner.points * 1.02 / (1.0 - scanner.holes)), p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), len(face))
    points = np.einsum("pk,pkc->pc", share, vertices[faces[face]])
    unit = normals[face] / np.maximum(area[face], 1e-12)[:, None]
    kept = np.ones(len(points), dtype=bool)
    if scanner.sides:
        kept = np.any([_seen(points, unit, np.array(side)) for side in scanner.sides], axis=0)
    points = points[kept]
    points = points[~_holes(points, scanner.holes, rng)][: scanner.points]
    return Scan(name, points + scanner.noise * rng.normal(size=points.shape))


def _holes(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Which points lie in holes: balls around points of the surface, as many as make up the share."""
    gone = np.zeros(len(points), dtype=bool)
    while len(points) and gone.mean() < share:
        gone |= ((points - points[rng.integers(len(points))]) ** 2).sum(1) < (PATCH * rng.uniform(0.5, 1.2)) ** 2
    return gone


def _seen(points: np.ndarray, normals: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Which points a far camera on that side sees."""
    across = np.cross(side, np.eye(3)[np.abs(side).argmin()])
    across /= np.linalg.norm(across)
    depth = points @ side
    cells = np.floor(points @ np.stack([across, np.cross(side, across)]).T / CELL).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    nearest = np.full(cell.max(initial=-1) + 1, -np.inf)
    np.maximum.at(nearest, cell.ravel(), depth)
    return (normals @ side > GRAZING) & (depth > nearest[cell.ravel()] - BEHIND)
