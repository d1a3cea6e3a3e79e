"""Numbers about a finished body, on people that were not used to build it."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .rig import JOINTS
from .shape_space import ShapeSpace, female_direction


def vertex_error(space: ShapeSpace, vertices: np.ndarray, components: int) -> float:
    """Mean distance in mm between bodies (N,V,3) and their best fit with the first components."""
    betas = space.fit(vertices)
    betas[:, components:] = 0
    return 1000 * float(np.linalg.norm(space.bodies(betas) - vertices, axis=2).mean())


def joint_errors(
    regressor: sparse.csr_matrix, vertices: np.ndarray, joints: np.ndarray
) -> dict[str, tuple[float, float]]:
    """Joint -> (mean, 95th percentile) distance in mm between regressed and true joints."""
    found = np.stack([regressor @ body for body in vertices])
    miss = 1000 * np.linalg.norm(found - joints, axis=2)
    return {name: (float(miss[:, k].mean()), float(np.percentile(miss[:, k], 95))) for k, name in enumerate(JOINTS)}


def sex_accuracy(betas: np.ndarray, female: np.ndarray, test: np.ndarray) -> float:
    """Share of held-out people whose sex the classifier fitted to the others tells; `test` (N,) bool."""
    weights, bias = female_direction(betas[~test], female[~test])
    return float(((betas[test] @ weights + bias > 0) == female[test]).mean())


def stature_range(space: ShapeSpace, top: int, limit: float) -> tuple[float, float]:
    """Smallest and largest stature in metres with every |beta| <= limit (head top above the lowest vertex of the
    mean).
    """
    sole = int(space.mean[:, 1].argmin())
    middle = space.mean[top, 1] - space.mean[sole, 1]
    reach = limit * np.abs(space.shapedirs[top, 1] - space.shapedirs[sole, 1]).sum()
    return float(middle - reach), float(middle + reach)
