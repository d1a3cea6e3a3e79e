"""The shape space: principal components of the people, in units of their standard deviations.

The first components are principal in a metric that counts measurements, further ones by surface.

Plain components over vertices spend themselves on what moves many vertices far; hands, feet, head
and girths, which the
survey measured, would come late. So a body is described by its vertices *and* its measurements,
each measurement
weighed by what it may be off, and the components are principal for both together (PCA in the metric
|dx|^2 + sum_m (w dm / tolerance_m)^2). Betas are the scores; what a beta does to the vertices is its loading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# root metres: all measurements off by their tolerance count as this error on every vertex
MEASURE_SHARE = 0.006


@dataclass(frozen=True)
class ShapeSpace:
    """mean (V,3), shapedirs (V,3,B) with unit-normal betas, the betas (N,B) of the people it was
    made of.

    Weighed measurements have a mean (M,) and directions (M,B) of their own.
    """

    mean: np.ndarray
    shapedirs: np.ndarray
    betas: np.ndarray
    variance: np.ndarray  # (N,) of all components, square metres summed over coordinates
    weight: float
    measured_mean: np.ndarray
    measured_dirs: np.ndarray

    def fit(
        self,
        vertices: np.ndarray,
        components: int | None = None,
        measures: np.ndarray | None = None,
    ) -> np.ndarray:
        """Least-squares betas (N,B) of bodies (N,V,3) with the first components; the others are
        zero.

        measures (N,M): the bodies' measurements divided by their tolerances; with them the space's
        own metric is used.
        """
        count = self.shapedirs.shape[-1]
        used = count if components is None else components
        basis = self.shapedirs[..., :used].reshape(-1, used).astype(np.float32)
        offsets = (vertices - self.mean).astype(np.float32).reshape(len(vertices), -1)
        square = (basis.T @ basis).astype(float)
        goal = (offsets @ basis).astype(float)
        if measures is not None:
            lines = self.weight * self.measured_dirs[:, :used]
            square += lines.T @ lines
            goal += self.weight * (measures - self.measured_mean) @ lines
        betas = np.zeros((len(vertices), count))
        betas[:, :used] = np.linalg.solve(square, goal.T).T
        return betas

    def bodies(self, betas: np.ndarray) -> np.ndarray:
        """Vertices (N,V,3)."""
        count = betas.shape[1]
        flat = self.shapedirs[..., :count].reshape(-1, count)
        return self.mean + (betas @ flat.T).reshape(len(betas), *self.mean.shape)


def principal_shapes(
    vertices: np.ndarray,
    components: int,
    mirror: np.ndarray,
    measures: np.ndarray | None = None,
    share: float = MEASURE_SHARE,
) -> ShapeSpace:
    """Components of symmetric bodies (N,V,3) through their Gram matrix, largest first; a
    component's sign makes stature grow with its beta.

    measures (N,M): measurements divided by their tolerances; without them the components are the
    vertices' own.
    """
    count = len(vertices)
    mean = vertices.mean(0, dtype=np.float64)
    offsets = (vertices - mean).astype(np.float32).reshape(count, -1)
    measures = np.zeros((count, 1)) if measures is None else measures
    weight = share * np.sqrt(len(mean) / measures.shape[1])
    measured = measures - measures.mean(0)
    gram = (offsets @ offsets.T).astype(np.float64) + weight**2 * measured @ measured.T
    values, vectors = np.linalg.eigh(gram)
    values = np.maximum(values[::-1], 0)
    vectors = vectors[:, ::-1]
    betas = vectors[:, :components] * np.sqrt(count - 1)
    shapedirs = (
        (betas.T.astype(np.float32) @ offsets / (count - 1))
        .reshape(components, -1, 3)
        .astype(np.float64)
    )
    rise = shapedirs[:, mean[:, 1].argmax(), 1] - shapedirs[:, mean[:, 1].argmin(), 1]
    sign = np.where(rise < 0, -1.0, 1.0)
    betas = betas * sign
    return ShapeSpace(
        mean=_symmetric(mean[..., None], mirror)[..., 0],
        shapedirs=_symmetric((shapedirs * sign[:, None, None]).transpose(1, 2, 0), mirror),
        betas=betas,
        variance=values / (count - 1),
        weight=weight,
        measured_mean=measures.mean(0),
        measured_dirs=measured.T @ betas / (count - 1),
    )


def with_further_shapes(
    space: ShapeSpace,
    vertices: np.ndarray,
    components: int,
    mirror: np.ndarray,
    measures: np.ndarray,
    area: np.ndarray,
    others: np.ndarray,
    share: float,
) -> ShapeSpace:
    """The space and `components` further ones: principal, weighed by surface, of what the first
    leave of the same bodies (N,V,3), whose measurements are `measures` (N,M), and of `others`
    (K,V,3), whose rest counts for `share` of its size. `area` (V,): surface that each vertex stands
    for.

    What is left is uncorrelated with the betas, so the further ones are, too; `others` make their
    variance among the people less than 1.
    """
    count = len(vertices)
    mean = vertices.mean(0, dtype=np.float64)
    root = np.repeat(np.sqrt(area / area.sum()), 3).astype(np.float32)
    first = space.shapedirs.reshape(-1, space.shapedirs.shape[-1]).astype(np.float32)
    left = (vertices - mean).astype(np.float32).reshape(count, -1)
    left -= (space.betas / (count - 1)).astype(np.float32) @ (
        space.betas.T.astype(np.float32) @ left
    )
    far = (others - mean).astype(np.float32).reshape(len(others), left.shape[1])
    basis = first * root[:, None]
    far -= np.linalg.solve(basis.T @ basis, basis.T @ (far * root).T).T @ first.T
    flat = np.concatenate([left, np.float32(share) * far])
    weighed = flat * root
    _, vectors = np.linalg.eigh((weighed @ weighed.T).astype(np.float64))
    scores = vectors[:, ::-1][:, :components] * np.sqrt(count - 1)
    shapes = (scores.T.astype(np.float32) @ flat / (count - 1)).reshape(components, -1, 3)
    further = _symmetric(shapes.transpose(1, 2, 0).astype(np.float64), mirror)
    betas = scores[:count]
    measured = (measures - space.measured_mean).T @ betas / (count - 1)
    return replace(
        space,
        shapedirs=np.concatenate([space.shapedirs, further], -1),
        betas=np.concatenate([space.betas, betas], 1),
        measured_dirs=np.concatenate([space.measured_dirs, measured], 1),
    )


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) a third of the area of the triangles (F,3) around each vertex, square metres."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices))


def skew_direction(space: ShapeSpace, measure: int, components: int) -> np.ndarray:
    """(B,) direction of the first betas in which a measurement grows, as long as the people's
    skewness along it.
    """
    line = space.measured_dirs[measure, :components]
    line = line / np.linalg.norm(line)
    along = space.betas[:, :components] @ line
    return float(((along - along.mean()) ** 3).mean() / along.std() ** 3) * line


def _symmetric(columns: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Columns (V,3,B) freed from rounding: each half is exactly the other's mirror image."""
    return 0.5 * (columns + columns[mirror] * np.array([-1.0, 1.0, 1.0])[:, None])


def female_direction(
    betas: np.ndarray, female: np.ndarray, ridge: float = 1.0
) -> tuple[np.ndarray, float]:
    """Logistic regression P(female) = sigmoid(weights . betas + bias), by Newton's method."""
    x = np.concatenate([betas, np.ones((len(betas), 1))], 1)
    w = np.zeros(x.shape[1])
    penalty = ridge * np.diag([1.0] * betas.shape[1] + [0.0])
    for _ in range(30):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -30, 30)))
        hessian = (x * (p * (1 - p))[:, None]).T @ x + penalty
        w += np.linalg.solve(hessian, x.T @ (female - p) - penalty @ w)
    return w[:-1], float(w[-1])
