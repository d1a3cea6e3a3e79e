"""The shape space: principal components of the people, in units of their standard deviations, and who is likely a
woman.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FIT_NOISE = 0.5  # standard deviation of betas estimated from a capture, about


@dataclass(frozen=True)
class ShapeSpace:
    """mean (V,3), shapedirs (V,3,B) with unit-normal betas, the betas (N,B) of the people it was made of."""

    mean: np.ndarray
    shapedirs: np.ndarray
    betas: np.ndarray
    variance: np.ndarray  # (N,) of all components, square metres summed over coordinates

    def fit(self, vertices: np.ndarray) -> np.ndarray:
        """Least-squares betas (N,B) of bodies (N,V,3)."""
        basis = self.shapedirs.reshape(-1, self.shapedirs.shape[-1])
        offsets = (vertices - self.mean).reshape(len(vertices), -1)
        return offsets @ basis / (basis**2).sum(0)

    def bodies(self, betas: np.ndarray) -> np.ndarray:
        """Vertices (N,V,3)."""
        return self.mean + np.einsum("vcb,nb->nvc", self.shapedirs, betas)


def principal_shapes(vertices: np.ndarray, components: int, mirror: np.ndarray) -> ShapeSpace:
    """PCA of symmetric bodies (N,V,3) through their Gram matrix; a component's sign makes stature grow with its
    beta.
    """
    count = len(vertices)
    mean = vertices.mean(0, dtype=np.float64)
    offsets = (vertices - mean).astype(np.float32).reshape(count, -1)
    values, vectors = np.linalg.eigh((offsets @ offsets.T).astype(np.float64))
    values, vectors = values[::-1], vectors[:, ::-1]
    sides = vectors[:, :components]
    basis = (sides.T @ offsets) / np.sqrt(values[:components])[:, None]
    rise = basis.reshape(components, -1, 3)[:, :, 1]
    sign = np.where(rise[:, mean[:, 1].argmax()] < rise[:, mean[:, 1].argmin()], -1.0, 1.0)
    scale = sign * np.sqrt(values[:components] / (count - 1))
    shapedirs = (basis * scale[:, None]).reshape(components, -1, 3).transpose(1, 2, 0)
    mean, shapedirs = _symmetric(mean[..., None], mirror)[..., 0], _symmetric(shapedirs, mirror)
    return ShapeSpace(mean, shapedirs, sides * sign * np.sqrt(count - 1), np.maximum(values, 0) / (count - 1))


def _symmetric(columns: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Columns (V,3,B) freed from rounding: each half is exactly the other's mirror image."""
    return 0.5 * (columns + columns[mirror] * np.array([-1.0, 1.0, 1.0])[:, None])


def as_if_fitted(betas: np.ndarray) -> np.ndarray:
    """Betas (N,B) with the error that a fit to markers or images leaves; fixed seed."""
    return betas + FIT_NOISE * np.random.default_rng(1).normal(size=betas.shape)


def female_direction(betas: np.ndarray, female: np.ndarray, ridge: float = 1.0) -> tuple[np.ndarray, float]:
    """Logistic regression P(female) = sigmoid(weights . betas + bias), by Newton's method."""
    x = np.concatenate([betas, np.ones((len(betas), 1))], 1)
    w = np.zeros(x.shape[1])
    penalty = ridge * np.diag([1.0] * betas.shape[1] + [0.0])
    for _ in range(30):
        p = 1 / (1 + np.exp(-x @ w))
        hessian = (x * (p * (1 - p))[:, None]).T @ x + penalty
        w += np.linalg.solve(hessian, x.T @ (female - p) - penalty @ w)
    return w[:-1], float(w[-1])
