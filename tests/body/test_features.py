import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from habitus.body.features import POSE_FEATURES, extended, find_pose_features
from habitus.errors import HabitusError
from habitus.rotations import left_jacobian, matrix_from_rotvec, rotvec_from_matrix

SCALES = (0.0, 1e-200, 1e-9, 1e-4, 0.3, 0.7072, 2.0, math.pi - 1e-6, math.pi, 4.0)
every = pytest.mark.parametrize("features", POSE_FEATURES.values(), ids=POSE_FEATURES.keys())
PER_JOINT = {"rotations": 9, "angles": 3, "sin_cos": 6, "quaternions": 4, "polynomials": 9}


def rotvecs(scale: float, *batch: int, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    axes = torch.nn.functional.normalize(torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1)
    return (scale * axes).to(dtype)


def by_an_independent_library(rotvec: np.ndarray) -> dict[str, list[float]]:
    rotation, (x, y, z) = Rotation.from_rotvec(rotvec), rotvec
    a, b, c, w = rotation.as_quat(canonical=True)
    return {
        "rotations": list((rotation.as_matrix() - np.eye(3)).ravel()),
        "angles": [x, y, z],
        "sin_cos": [math.sin(x), math.sin(y), math.sin(z), math.cos(x) - 1, math.cos(y) - 1, math.cos(z) - 1],
        "quaternions": [w - 1, a, b, c],
        "polynomials": [x, y, z, x * x, y * y, z * z, x * y, x * z, y * z],
    }


@every
@pytest.mark.parametrize("scale", [0.0, 1e-5, 0.6, 3.0, 4.0])
def test_features_are_what_their_names_say(features, scale):
    for rotvec in rotvecs(scale, 4):
        known = by_an_independent_library(rotvec.numpy())[features.name]
        assert np.abs(features.value(rotvec).numpy() - known).max() < 1e-14
        assert features.per_joint == len(known) == PER_JOINT[features.name]


@every
@pytest.mark.parametrize("scale", SCALES)
def test_slopes_are_autodiff_over_the_left_jacobian(features, scale):
    for rotvec in rotvecs(scale, 5):
        by_vector = torch.func.jacrev(features.value)(rotvec)
        expected = by_vector @ torch.linalg.inv(left_jacobian(rotvec))
        assert (features.slope(rotvec) - expected).abs().max() < 1e-13


@every
@pytest.mark.parametrize("scale", [0.0, 1e-3, 1.0, 3.0])
def test_slopes_are_what_small_turns_from_the_left_show(features, scale):
    step = 1e-5
    for rotvec in rotvecs(scale, 3):
        value = lambda turn: features.value(  # noqa: E731
            rotvec_from_matrix(matrix_from_rotvec(turn) @ matrix_from_rotvec(rotvec))  # noqa: B023
        )
        for axis, column in zip(step * torch.eye(3, dtype=torch.float64), features.slope(rotvec).mT, strict=True):
            assert ((value(axis) - value(-axis)) / (2 * step) - column).abs().max() < 1e-9


@every
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rest_gives_zeros_and_batches_and_precisions_agree(features, dtype):
    assert not features.value(torch.zeros(2, 5, 3, dtype=dtype)).any()
    vectors = rotvecs(1.3, 2, 5)
    value, slope = features.value(vectors.to(dtype)), features.slope(vectors.to(dtype))
    assert value.dtype == slope.dtype == dtype
    assert value.shape == (2, 5, features.per_joint) and slope.shape == (2, 5, features.per_joint, 3)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-15
    assert (value[1, 2] - features.value(vectors[1, 2])).abs().max() < tolerance
    assert (slope[1, 2] - features.slope(vectors[1, 2])).abs().max() < 3 * tolerance


@every
def test_gradients_of_values_and_slopes_are_finite_and_right_even_at_rest(features):
    for scale in (0.0, 1.0):
        vectors = rotvecs(scale, 3).requires_grad_()
        assert torch.autograd.gradcheck(lambda v: (features.value(v), features.slope(v)), vectors)


@every
def test_the_root_drives_nothing_and_matrices_say_the_same(features):
    pose = rotvecs(0.8, 2, 6)
    flat = features.of_pose(pose, matrix_from_rotvec(pose))
    assert flat.shape == (2, features.count(6)) and features.count(6, 2) == 3 * features.count(6)
    assert (flat - features.value(pose)[:, 1:].flatten(-2)).abs().max() < 1e-15


def test_quaternions_know_the_rotation_only():
    """The two vectors of a rotation have one quaternion with positive real part, but two of everything raw."""
    near = rotvecs(2.5, 4)
    far = near * (1 - 2 * math.pi / 2.5)
    for name, same in (("rotations", True), ("quaternions", True), ("angles", False), ("polynomials", False)):
        value = POSE_FEATURES[name].value
        assert ((value(near) - value(far)).abs().max() < 1e-13) == same, name


def test_extended_features_are_products_with_the_first_coefficients():
    feature, betas = torch.randn(4, 1, 6), torch.randn(3, 5)
    assert extended(feature, betas, 0) is feature
    found = extended(feature, betas, 2)
    assert found.shape == (4, 3, 18)
    for n, factor in enumerate((torch.ones(3), betas[:, 0], betas[:, 1])):
        assert torch.equal(found[..., 6 * n : 6 * n + 6], (factor[:, None] * feature).expand(4, 3, 6))


def test_unknown_features_are_refused():
    with pytest.raises(HabitusError, match=r"'magic'; expected one of rotations, angles, sin_cos"):
        find_pose_features("magic")
