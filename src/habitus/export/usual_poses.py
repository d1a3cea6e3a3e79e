"""Poses that people take, to weigh by: which of a body's pose blend shapes they need."""

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.shipped_prior import prior_of
from habitus.rotations import matrix_from_rotvec

SAMPLES, WIDER, LOOSE = 1000, 2.0, 0.1
"""So many poses, of so many times the prior's variance, and so far beyond it in every axis of every
joint (rad).
"""


def sampled_rotations(body: BodyModel) -> Float[np.ndarray, "S J 3 3"]:
    """The same poses for every motion of a body, so that its files have the same blend shapes.

    From the body's own pose prior, or the one that comes along; wider, because animators go further
    than captures.
    """
    prior = prior_of(body).for_joints(body.joint_names)
    spread = WIDER * prior.covariance + LOOSE**2 * np.eye(len(prior.mean))
    rng = np.random.default_rng(0)
    vectors = (
        prior.mean + rng.normal(size=(SAMPLES, len(prior.mean))) @ np.linalg.cholesky(spread).T
    )
    turned = matrix_from_rotvec(vectors.reshape(SAMPLES, -1, 3))
    return np.concatenate([np.broadcast_to(np.eye(3), (SAMPLES, 1, 3, 3)), turned], axis=1)
