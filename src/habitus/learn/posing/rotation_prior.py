"""A prior on pose blend shapes at rotations that no registration shows.

Least squares determines a joint's blend shapes P_j only along the features f(R) that occur in the
registrations; along the others (the twist of an elbow, a knee bent sideways) they are whatever the
noise left, and extrapolate. The prior is their mean squared offset over rotations by 0 to 90
degrees about every axis, with a small weight mu against the N registrations:

    E_R = mu N sum_j tr(P_j G_w P_j'),      G_w = E[f f'] over these rotations.

Directions that the poses determine stay; the others shrink.
"""

import numpy as np
from jaxtyping import Float

from habitus.body.pose_features import PoseFeatures

LARGEST_ANGLE = np.pi / 2
"""rad: rotations of the prior are by 0 to this."""
_ANGLES = 24


def rotation_gram(
    features: PoseFeatures, largest: float = LARGEST_ANGLE
) -> Float[np.ndarray, "k k"]:
    """G_w = E[f f'] of one joint's features over axes uniform on the sphere and angles uniform in 0
    to ``largest`` (rad).

    By quadrature: Lebedev's 26 axes, exact for polynomials of the axis to degree 7, and
    Gauss-Legendre angles.
    """
    axes, axis_weights = _lebedev_26()
    nodes, angle_weights = np.polynomial.legendre.leggauss(_ANGLES)
    angles = largest * (nodes + 1) / 2
    values = features.value(angles[:, None, None] * axes)
    weights = angle_weights[:, None] / 2 * axis_weights
    return np.einsum("an,ani,anj->ij", weights, values, values)


def _lebedev_26() -> tuple[Float[np.ndarray, "26 3"], Float[np.ndarray, " 26"]]:
    """Axes through a cube's faces, edges and corners, and their weights (sum 1)."""
    steps = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3)
    size = (steps**2).sum(1)
    axes = steps[size > 0] / np.sqrt(size[size > 0])[:, None]
    return axes, np.array([1 / 21, 4 / 105, 9 / 280])[size[size > 0].astype(int) - 1]
