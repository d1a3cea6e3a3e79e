"""The prior on pose blend shapes at rotations that no registration shows."""

import numpy as np
import pytest

from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.posing.rotation_prior import rotation_gram

ENTRIES = POSE_FEATURES["rotations"]


def closed_form(largest: float) -> np.ndarray:
    """E[f f'] of vec(R - I) = sin t vec(K) + (1 - cos t) vec(K^2), K the cross product with an axis
    u: with E[u_i u_j] = d_ij / 3 and E[u_i u_j u_k u_l] = (d_ij d_kl + d_ik d_jl + d_il d_jk) / 15.
    """
    one = np.eye(3)
    same = np.einsum("im,jn->ijmn", one, one)
    swapped = np.einsum("in,jm->ijmn", one, one)
    traces = np.einsum("ij,mn->ijmn", one, one)
    odd = (same - swapped) / 3
    even = (1 / 15 + 1 / 3) * traces + (same + swapped) / 15
    t = largest
    sines = 0.5 - np.sin(2 * t) / (4 * t)
    cosines = 1.5 - 2 * np.sin(t) / t + np.sin(2 * t) / (4 * t)
    return (sines * odd + cosines * even).reshape(9, 9)


@pytest.mark.parametrize("largest", [0.3, np.pi / 2, 3.0])
def test_the_gram_matrix_is_the_mean_over_all_axes_and_angles(largest) -> None:
    np.testing.assert_allclose(rotation_gram(ENTRIES, largest), closed_form(largest), atol=1e-14)


@pytest.mark.parametrize("name", [name for name in POSE_FEATURES if name != "rotations"])
def test_other_features_have_the_mean_of_random_rotations(name) -> None:
    features = POSE_FEATURES[name]
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(200_000, 3))
    axes *= (rng.random(len(axes)) * np.pi / 2 / np.linalg.norm(axes, axis=1))[:, None]
    drawn = features.value(axes)
    np.testing.assert_allclose(
        rotation_gram(features), drawn.T @ drawn / len(axes), atol=0.01, rtol=0.03
    )
