"""Shapes with holes: what is unseen of a surface is what the shape space says of the rest of it."""

import numpy as np
from jaxtyping import Bool, Float

from habitus.learn.shape.shape_space import ShapeSpace, principal_shapes
from habitus.mesh.registrations import Vertices

TURNS = 12


def shapes_with_holes(
    surfaces: Vertices, seen: Bool[np.ndarray, "S V"], count: int, turns: int = TURNS
) -> tuple[Float[np.ndarray, "S V 3"], ShapeSpace]:
    """Surfaces (m) whose unseen vertices are replaced, and their shape space: `principal_shapes`,
    in turns with the most likely rest of each surface (expectation maximisation; Roweis, "EM
    algorithms for PCA and SPCA", 1998).

    Coefficients are drawn to the mean as much as the seen vertices' distance from the space asks
    for. Unseen vertices start where they are in ``surfaces``.
    """
    filled = np.array(surfaces[:], dtype=np.float64)
    rows = np.flatnonzero(~seen.all(1))
    for _ in range(turns):
        space = principal_shapes(filled, count)
        left = space.variances[space.num_betas :].sum() / space.mean.size
        for row in rows.tolist():
            filled[row, ~seen[row]] = _likely(space, filled[row], seen[row], max(left, 1e-10))[
                ~seen[row]
            ]
    return filled, principal_shapes(filled, count)


def _likely(
    space: ShapeSpace,
    surface: Float[np.ndarray, "V 3"],
    seen: Bool[np.ndarray, " V"],
    variance: float,
) -> Float[np.ndarray, "V 3"]:
    """The surface of the space that is most likely, given some vertices, each with so much variance
    (m^2).
    """
    columns = space.directions[seen].reshape(-1, space.num_betas)
    away = (surface - space.mean)[seen].ravel()
    betas = np.linalg.solve(
        columns.T @ columns + variance * np.eye(space.num_betas), columns.T @ away
    )
    return space.reconstruct(betas)
