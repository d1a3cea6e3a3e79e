import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus import rotations as rot

ANGLES = (
    0.0,
    1e-160,
    1e-12,
    1e-6,
    1e-3,
    0.1,
    0.70710677,
    0.7071068,
    1.0,
    2.0,
    math.pi - 1e-3,
    math.pi - 1e-7,
    math.pi,
)
EPS = {torch.float32: 2e-6, torch.float64: 5e-15}
both = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def axes(count: int = 6, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(count)
    random = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(
        torch.cat([torch.eye(3, dtype=torch.float64), -random]), dim=-1
    ).to(dtype)


def rotvecs(dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Every angle about every axis: (angles, axes, 3)."""
    return torch.tensor(ANGLES, dtype=dtype)[:, None, None] * axes(dtype=dtype)


@both
def test_matrices_are_the_exponential_of_the_cross_matrix(dtype):
    v = rotvecs(dtype)
    exact = torch.linalg.matrix_exp(rot.cross_matrix(v.double()))
    assert (rot.matrix_from_rotvec(v) - exact).abs().max() < EPS[dtype]


@both
def test_vectors_come_back_from_matrices_and_quaternions(dtype):
    count = (
        -1 if dtype == torch.float64 else -2
    )  # at pi, and within a rounding of it, both signs are right
    v = rotvecs(dtype)[:count]
    assert (rot.rotvec_from_matrix(rot.matrix_from_rotvec(v)) - v).abs().max() < 10 * EPS[dtype]
    assert (rot.rotvec_from_quaternion(rot.quaternion_from_rotvec(v)) - v).abs().max() < 10 * EPS[
        dtype
    ]
    matrix = rot.matrix_from_rotvec(rotvecs(dtype))
    assert (rot.matrix_from_rotvec(rot.rotvec_from_matrix(matrix)) - matrix).abs().max() < 10 * EPS[
        dtype
    ]


@both
def test_small_angles_keep_their_relative_precision(dtype):
    v = torch.tensor([1e-15, -2e-15, 3e-16], dtype=dtype)
    back = rot.rotvec_from_quaternion(rot.quaternion_from_rotvec(v))
    assert ((back - v) / v).abs().max() < EPS[dtype]


@both
def test_quaternions_and_matrices_tell_the_same_rotation(dtype):
    q = rot.quaternion_from_rotvec(rotvecs(dtype))
    matrix = rot.matrix_from_rotvec(rotvecs(dtype))
    assert (rot.matrix_from_quaternion(q) - matrix).abs().max() < EPS[dtype]
    assert (rot.matrix_from_quaternion(-3 * q) - matrix).abs().max() < EPS[dtype]
    again = rot.quaternion_from_matrix(matrix)
    assert (again.norm(dim=-1) - 1).abs().max() < EPS[dtype]
    assert ((again * q).sum(-1).abs() - 1).abs().max() < EPS[dtype]


vectors = st.lists(st.floats(-3, 3, width=32), min_size=3, max_size=3).map(
    lambda v: torch.tensor(v, dtype=torch.float64)
)


@settings(max_examples=60, deadline=None)
@given(vectors, vectors, vectors)
def test_products_compose(a, b, point):
    p = rot.quaternion_from_rotvec(a)
    q = rot.quaternion_from_rotvec(b)
    matrix = rot.matrix_from_rotvec(a) @ rot.matrix_from_rotvec(b)
    assert torch.allclose(
        rot.matrix_from_quaternion(rot.quaternion_multiply(p, q)), matrix, atol=1e-14
    )
    turned = rot.quaternion_multiply(
        rot.quaternion_multiply(q, rot.pure_quaternion(point)), rot.quaternion_conjugate(q)
    )
    assert torch.allclose(turned[1:], rot.matrix_from_rotvec(b) @ point, atol=1e-13)
    assert torch.allclose(rot.cross_matrix(a) @ point, torch.linalg.cross(a, point), atol=1e-14)


@settings(max_examples=60, deadline=None)
@given(vectors, vectors)
def test_rigid_motions_survive_dual_quaternions_of_any_length(rotvec, shift):
    matrix = rot.matrix_from_rotvec(rotvec)
    dual = rot.dual_quaternion_from_rigid(matrix, shift)
    for scale in (1.0, -0.3):
        back, moved = rot.rigid_from_dual_quaternion(scale * dual)
        assert torch.allclose(back, matrix, atol=1e-14) and torch.allclose(moved, shift, atol=1e-13)
    unnormalised = torch.cat(
        [dual[:4], dual[4:] + 0.7 * dual[:4]]
    )  # not on the manifold: the excess must not move points
    assert torch.allclose(rot.rigid_from_dual_quaternion(unnormalised)[1], shift, atol=1e-13)


def test_left_jacobian_is_the_derivative_of_the_matrix():
    v = rotvecs()
    for index in range(3):
        tangent = torch.zeros_like(v)
        tangent[..., index] = 1
        _, change = torch.func.jvp(rot.matrix_from_rotvec, (v,), (tangent,))
        spin = rot.cross_matrix(rot.left_jacobian(v)[..., index]) @ rot.matrix_from_rotvec(v)
        assert (spin - change).abs().max() < 5e-14


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("name", ["matrix_from_rotvec", "quaternion_from_rotvec", "left_jacobian"])
def test_first_and_second_derivatives_are_right_at_every_angle(name, angle):
    v = (angle * axes(1)[-1:]).requires_grad_()
    function = getattr(rot, name)
    assert torch.autograd.gradcheck(function, v, atol=1e-7)
    assert torch.autograd.gradgradcheck(function, v, atol=1e-5)


@both
@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_there_and_back_has_the_identity_as_derivative(angle, dtype):
    v = angle * axes(dtype=dtype)
    jacobian = torch.func.vmap(
        torch.func.jacrev(lambda x: rot.rotvec_from_matrix(rot.matrix_from_rotvec(x)))
    )(v)
    loss_near_pi = 1 / max(math.pi - angle, 1e-6) if angle > 3 else 10
    assert (jacobian - torch.eye(3)).abs().max() < 20 * loss_near_pi * EPS[dtype]


def test_nothing_jumps_where_series_end():
    edge = math.sqrt(0.5)
    below, above = (axes() * edge * (1 + step) for step in (-1e-15, 1e-15))
    for function in (rot.matrix_from_rotvec, rot.left_jacobian, rot.quaternion_from_rotvec):
        assert (function(below) - function(above)).abs().max() < 5e-15


@both
def test_procrustes_finds_the_motion_that_was_made(dtype):
    torch.manual_seed(0)
    source = torch.randn(5, 2, 20, 3, dtype=dtype)
    matrix = rot.matrix_from_rotvec(2 * torch.randn(5, 2, 3, dtype=dtype))
    shift = torch.randn(5, 2, 3, dtype=dtype)
    target = source @ matrix.mT + shift[..., None, :]
    found, moved = rot.procrustes(source, target)
    assert (found - matrix).abs().max() < 10 * EPS[dtype] and (
        moved - shift
    ).abs().max() < 10 * EPS[dtype]
    weights = torch.rand(5, 2, 20, dtype=dtype)
    weights[..., 3] = 0
    target[..., 3, :] += 100
    found, moved = rot.procrustes(source, target, weights)
    assert (found - matrix).abs().max() < 10 * EPS[dtype] and (
        moved - shift
    ).abs().max() < 10 * EPS[dtype]


def test_procrustes_is_the_best_proper_rotation_even_for_mirror_images():
    torch.manual_seed(1)
    source = torch.randn(4, 12, 3, dtype=torch.float64)
    target = source * torch.tensor([1.0, 1.0, -1.0]) + 0.1 * torch.randn_like(source)
    weights = torch.rand(4, 12, dtype=torch.float64)
    matrix, shift = rot.procrustes(source, target, weights)
    assert torch.allclose(torch.linalg.det(matrix), torch.ones(4, dtype=torch.float64))

    def cost(matrix, shift):
        return (weights * ((source @ matrix.mT + shift[..., None, :] - target) ** 2).sum(-1)).sum(
            -1
        )

    best = cost(matrix, shift)
    for scale in (1e-3, 0.1, 1.0, 3.0):
        turn = rot.matrix_from_rotvec(scale * torch.randn(4, 3, dtype=torch.float64))
        assert (cost(turn @ matrix, shift) > best).all()
        assert (cost(matrix, shift + scale * torch.randn(4, 3, dtype=torch.float64)) > best).all()


def test_procrustes_can_be_differentiated():
    torch.manual_seed(2)
    source = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    target = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rot.procrustes, (source, target))
