"""Rows of hinge channels: what tells by how many degrees a bone is folded over its joint.

With u the bone's direction at rest and h = axis x u, a bend of t about the axis takes u to
cos t u + sin t h. A channel's driver is linear in R,

    x(R) = cos t_c (u . R u) + sin t_c (h . R u) - cos(t_0 - t_c),

which about the hinge is cos(t - t_c) - cos(t_0 - t_c): zero where the fold begins, t_0, rising to
the centre t_c, and blind to twist about the bone. It is scaled to 1 at ``FULL``.
"""

import numpy as np
from jaxtyping import Float

CENTRE = np.radians(165.0)
"""t_c: beyond what joints reach, so that channels rise over the whole range."""
FULL = np.radians(155.0)
"""A channel's driver is 1 here; weights are cut off at 1."""


def hinge_row(
    bone: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"], begins: float
) -> tuple[Float[np.ndarray, " 9"], float]:
    """The row and the bias of a channel that begins at a bend of ``begins`` (rad) about ``axis``;
    ``bone`` points from the joint to the next.
    """
    u = bone / np.linalg.norm(bone)
    across = axis - (axis @ u) * u
    h = np.cross(across / np.linalg.norm(across), u)
    size = np.cos(FULL - CENTRE) - np.cos(begins - CENTRE)
    row = np.outer(np.cos(CENTRE) * u + np.sin(CENTRE) * h, u).ravel() / size
    bias = (np.cos(begins - CENTRE) - np.cos(CENTRE)) / size
    return row, float(bias)
