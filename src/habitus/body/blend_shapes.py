"""Blend shapes: what shape and pose add to the template (S 3, eqs. 8 and 9).

Bases are kept as rows of flattened surfaces, (directions, 3N) with coordinates before vertices, so
that one matrix product gives a batch of surfaces.
"""

import numpy as np
from jaxtyping import Float

from habitus.arrays import flatten, namespace, unflatten
from habitus.types import Array


def flat_rows(directions: Float[np.ndarray, "N 3 K"]) -> Float[np.ndarray, "K M"]:
    """Directions (N, 3, K) as K rows of 3N numbers: x of all vertices, then y, then z."""
    return np.ascontiguousarray(directions.transpose(2, 1, 0)).reshape(
        directions.shape[-1], 3 * len(directions)
    )


def add_blend_shapes(
    base: Float[Array, "*base M"], coefficients: Float[Array, "*batch K"], rows: Float[Array, "K M"]
) -> Float[Array, "*batch M"]:
    """``base + coefficients @ rows``; ``base`` is one surface or one for each of the batch."""
    xp = namespace(coefficients)
    if xp is np:
        return coefficients @ rows + base
    if not coefficients.shape[:-1]:
        return xp.addmv(base, rows.T, coefficients)
    batch = coefficients.shape[:-1]
    base = base if base.ndim == 1 else flatten(base.expand(*batch, base.shape[-1]), 0, -2)
    return unflatten(xp.addmm(base, flatten(coefficients, 0, -2), rows), 0, batch)
