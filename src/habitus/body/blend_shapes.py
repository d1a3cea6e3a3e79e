"""Blend shapes: what shape and pose add to the template (S 3, eqs. 8 and 9).

Bases are kept as rows of flattened surfaces, (directions, 3N) with coordinates before vertices, so that one matrix
product gives a batch of surfaces.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def flat_rows(directions: Float[Tensor, "N 3 K"]) -> Float[Tensor, "K M"]:
    """Directions (N, 3, K) as K rows of 3N numbers: x of all vertices, then y, then z."""
    return directions.permute(2, 1, 0).reshape(directions.shape[-1], -1).contiguous()


def add_blend_shapes(
    base: Float[Tensor, "*base M"], coefficients: Float[Tensor, "*batch K"], rows: Float[Tensor, "K M"]
) -> Float[Tensor, "*batch M"]:
    """``base + coefficients @ rows`` in one pass; ``base`` is one surface or one for each of the batch."""
    if not coefficients.shape[:-1]:
        return torch.addmv(base, rows.T, coefficients)
    batch = coefficients.shape[:-1]
    base = base if base.ndim == 1 else base.expand(*batch, base.shape[-1]).flatten(0, -2)
    return torch.addmm(base, coefficients.flatten(0, -2), rows).unflatten(0, batch)
