import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic import synthetic_body, with_features

from habitus.body.pose_features import (
    POSE_FEATURES,
    check_driven_by_rotations,
    extended,
    find_pose_features,
    of_joints,
)
from habitus.errors import HabitusError
from habitus.rotations import left_jacobian, matrix_from_rotvec, rotvec_from_matrix

SCALES = (0.0, 1e-200, 1e-9, 1e-4, 0.3, 0.7072, 2.0, math.pi - 1e-6, math.pi, 4.0)
every = pytest.mark.parametrize("features", POSE_FEATURES.values(), ids=POSE_FEATURES.keys())
PER_JOINT = {"rotations": 9, "angles": 3, "sin_cos": 6, "quaternions": 4, "polynomials": 9}


def rotvecs(scale: float, *batch: int, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    axes = torch.nn.functional.normalize(
        torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    return (scale * axes).to(dtype)


def by_an_independent_library(rotvec: np.ndarray) -> dict[str, list[float]]:
    rotation, (x, y, z) = Rotation.from_rotvec(rotvec), rotvec
    a, b, c, w = rotation.as_quat(canonical=True)
    return {
        "rotations": list((rotation.as_matrix() - np.eye(3)).ravel()),
        "angles": [x, y, z],
        "sin_cos": [
            math.sin(x),
            math.sin(y),
            math.sin(z),
            math.cos(x) - 1,
            math.cos(y) - 1,
            math.cos(z) - 1,
        ],
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
        for axis, column in zip(
            step * torch.eye(3, dtype=torch.float64), features.slope(rotvec).mT, strict=True
        ):
            assert ((value(axis) - value(-axis)) / (2 * step) - column).abs().max() < 1e-9


@every
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rest_gives_zeros_and_batches_and_precisions_agree(features, dtype):
    assert not features.value(torch.zeros(2, 5, 3, dtype=dtype)).any()
    vectors = rotvecs(1.3, 2, 5)
    value = features.value(vectors.to(dtype))
    slope = features.slope(vectors.to(dtype))
    assert value.dtype == slope.dtype == dtype
    assert value.shape == (2, 5, features.per_joint) and slope.shape == (
        2,
        5,
        features.per_joint,
        3,
    )
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
    """The two vectors of a rotation have one quaternion with positive real part, but two of
    everything raw.
    """
    near = rotvecs(2.5, 4)
    far = near * (1 - 2 * math.pi / 2.5)
    for name, same in (
        ("rotations", True),
        ("quaternions", True),
        ("angles", False),
        ("polynomials", False),
    ):
        value = POSE_FEATURES[name].value
        assert ((value(near) - value(far)).abs().max() < 1e-13) == same, name


def test_extended_features_are_products_with_the_first_coefficients():
    feature = torch.randn(4, 1, 6)
    betas = torch.randn(3, 5)
    assert extended(feature, betas, 0) is feature
    found = extended(feature, betas, 2)
    assert found.shape == (4, 3, 18)
    for n, factor in enumerate((torch.ones(3), betas[:, 0], betas[:, 1])):
        assert torch.equal(
            found[..., 6 * n : 6 * n + 6], (factor[:, None] * feature).expand(4, 3, 6)
        )


def test_unknown_features_are_refused():
    with pytest.raises(HabitusError, match=r"'magic'; expected one of rotations, angles, sin_cos"):
        find_pose_features("magic")


def random_state(body, *batch: int, dtype=torch.float64):
    generator = torch.Generator().manual_seed(5)
    normal = lambda *shape: torch.randn(*batch, *shape, generator=generator, dtype=dtype)  # noqa: E731
    return normal(body.num_betas), 0.7 * normal(body.num_joints, 3), normal(3)


SOME = (11, 3, 7)


@pytest.mark.parametrize("joints", [None, SOME])
@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
@pytest.mark.parametrize("shapes", [0, 2])
@every
def test_a_body_adds_its_features_one_by_one(features, shapes, skinning, joints):
    """Offsets worked out joint by joint with an independent library; skinning is that of a body
    without any.
    """
    body = with_features(
        replace(synthetic_body("mano", 60), skinning=skinning), features.name, shapes, joints
    )
    betas, pose, trans = random_state(body)
    driving = pose[1:] if joints is None else pose[list(joints)]
    each = [by_an_independent_library(turn)[features.name] for turn in driving.numpy()]
    joint_by_joint = np.concatenate(each)
    offset = np.zeros((60, 3))
    count = len(joint_by_joint)
    for block, factor in enumerate([1.0, *betas[:shapes].tolist()]):
        offset += factor * body.posedirs[..., count * block : count * (block + 1)] @ joint_by_joint
    plain = replace(body, posedirs=None, v_template=body.v_template + offset)
    keeps_joints = torch.as_tensor(body.joint_template - plain.joint_template)
    found = body(betas, pose, trans)
    known = plain.prepare(betas)
    known = replace(known, rest_joints=known.rest_joints + keeps_joints)(
        pose, trans
    )  # offsets move no joint
    assert (found.vertices - known.vertices).abs().max() < 1e-13
    assert (found.joints - known.joints).abs().max() < 1e-13
    readable = body(betas, pose.clone().requires_grad_(), trans)
    assert (found.vertices - readable.vertices).abs().max() < 1e-13
    array = body(betas.numpy(), pose.numpy(), trans.numpy()).vertices
    assert np.abs(array - found.vertices.numpy()).max() < 1e-13


@pytest.mark.parametrize("shapes", [0, 2])
@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
def test_joints_that_drive_nothing_may_be_written_out(skinning, shapes):
    """Zeros for the joints that do not drive: SMPL's own form of the same body, in any order of the
    joints.
    """
    body = with_features(
        replace(synthetic_body("mano", 60), skinning=skinning), "rotations", shapes, SOME
    )
    wide = replace(body, posedirs=body.smpl_posedirs(), pose_joints=None)
    assert (
        wide.posedirs.shape == (60, 3, 9 * 15 * (1 + shapes))
        and body.smpl_posedirs([4, 2]).shape[0] == 2
    )
    betas, pose, trans = random_state(body, 3)
    assert (
        body(betas, pose, trans).vertices - wide(betas, pose, trans).vertices
    ).abs().max() < 1e-13
    others = body.drivers + [k for k in range(1, 16) if k not in body.drivers]
    shuffled = np.concatenate([of_joints(body.posedirs, 9, SOME, tuple(others), shapes)], -1)
    mixed = replace(body, posedirs=shuffled, pose_joints=tuple(others))
    assert (
        body(betas, pose, trans).vertices - mixed(betas, pose, trans).vertices
    ).abs().max() < 1e-13
    for wrong in ((0, 3, 7), (3, 3, 7), (3, 7, 16)):
        with pytest.raises(HabitusError, match="expected different joints from 1 to 15"):
            replace(body, pose_joints=wrong)
    with pytest.raises(
        HabitusError, match=r"posedirs has \d+ directions; expected \d+: 'rotations' of 2 joints"
    ):
        replace(body, pose_joints=(3, 7))


@every
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bodies_of_all_features_rest_batch_and_take_soft_tissue(features, dtype):
    body = with_features(synthetic_body("mano", 50), features.name, 2)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    betas, pose, trans = random_state(body, 2, 3, dtype=dtype)
    assert torch.equal(
        body(betas, 0 * pose).vertices, replace(body, posedirs=None)(betas, 0 * pose).vertices
    )
    whole = body(betas, pose, trans).vertices
    assert (
        whole[1, 2] - body(betas[1, 2], pose[1, 2], trans[1, 2]).vertices
    ).abs().max() < tolerance
    shared = body.prepare(betas[0, 0], [4, 4, 17])(
        pose, trans
    ).vertices  # one shape, many poses, some vertices
    assert (
        shared - body(betas[:1, :1], pose, trans).vertices[..., [4, 4, 17], :]
    ).abs().max() < tolerance
    soft = body(betas, pose[0, 0], soft_tissue=0.3 * betas).vertices  # many shapes, one pose
    assert (soft - body(1.3 * betas, pose[:1, :1]).vertices).abs().max() < tolerance


def test_bodies_that_do_not_fit_their_features_are_refused():
    body = with_features(synthetic_body("mano", 50), "angles", 2)
    with pytest.raises(
        HabitusError,
        match=r"135 directions; expected 45: 'angles' of 15 joints, with 0 shape_features",
    ):
        replace(synthetic_body("mano", 50), pose_features="angles")
    with pytest.raises(
        HabitusError, match=r"posedirs has 135 directions; expected 90: .* with 1 shape_features"
    ):
        replace(body, shape_features=1)
    with pytest.raises(HabitusError, match="expected one of rotations, angles"):
        replace(body, pose_features="magic")
    for wrong in (-1, 11):
        with pytest.raises(HabitusError, match=f"shape_features is {wrong}; expected 0 to 10"):
            replace(body, shape_features=wrong)


def test_shape_that_pose_blend_shapes_depend_on_is_not_cut_off():
    body = with_features(synthetic_body("mano", 50), "rotations", 2)
    betas, pose, _ = random_state(body)
    betas[2:] = 0
    assert torch.allclose(
        body.with_betas(2)(betas[:2], pose).vertices, body(betas, pose).vertices, atol=1e-14
    )
    with pytest.raises(HabitusError, match="depend on the first 2; ask for 2 to 10"):
        body.with_betas(1)
    assert replace(body, posedirs=None).with_betas(1).num_betas == 1


def test_whoever_needs_rotations_is_told():
    body = synthetic_body("mano", 50)
    angles = with_features(body, "angles")
    for fine in (body, replace(angles, posedirs=None)):
        check_driven_by_rotations(fine, "marker fits")
    with pytest.raises(
        HabitusError, match="driven by 'angles'; marker fits need 'rotations' alone"
    ):
        check_driven_by_rotations(angles, "marker fits")
    with pytest.raises(
        HabitusError, match="driven by 'rotations' times 2 shape coefficients; exports need"
    ):
        check_driven_by_rotations(with_features(body, "rotations", 2), "exports")
