"""Rotations in the forms a body needs: vectors, matrices, quaternions, dual quaternions, and the best rigid fit.

All functions are batched over leading axes, work in float32 and float64 on any device, and have finite first and second
derivatives at the zero rotation: near it, power series in the squared angle replace the closed forms.

A rotation vector is axis times angle in radians (S 3, eq. 1). Quaternions are (w, x, y, z). Rigid motions map ``x`` to
``R x + t``.
"""

import torch
from jaxtyping import Float
from torch import Tensor

_SERIES_BELOW = 0.5  # squared angle (rad^2); eight terms leave less than one unit in the last place of float64 there


def _series(x: Tensor, first: float, n: int) -> Tensor:
    """Eight terms of the power series in x from ``first`` on; each next is -x / ((n + 1) (n + 2)) times the last."""
    coefficients = [first]
    for k in range(n, n + 14, 2):
        coefficients.append(-coefficients[-1] / ((k + 1) * (k + 2)))
    total = x * coefficients[-1] + coefficients[-2]
    for coefficient in reversed(coefficients[:-2]):
        total = total * x + coefficient
    return total


def _near_and_far(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the series hold; the squared angles for them; and those for the closed forms, kept away from zero."""
    small = squared < _SERIES_BELOW
    return small, squared.where(small, 0.0), squared.where(~small, 1.0)


def _sine_over_angle(squared: Tensor) -> tuple[Tensor, Tensor]:
    """sin n / n and (1 - cos n) / n^2 as smooth functions of n^2."""
    small, near, far = _near_and_far(squared)
    n = far.sqrt()
    half = torch.sin(n / 2)
    return torch.where(small, _series(near, 1.0, 1), torch.sin(n) / n), torch.where(
        small, _series(near, 0.5, 2), 2 * half * half / far
    )


def _angle_less_sine(squared: Tensor) -> Tensor:
    """(n - sin n) / n^3 as a smooth function of n^2."""
    small, near, far = _near_and_far(squared)
    n = far.sqrt()
    return torch.where(small, _series(near, 1 / 6, 3), (n - torch.sin(n)) / (far * n))


def cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix ``[v]x`` with ``[v]x u = v x u``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def matrix_from_rotvec(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula (S 3, eq. 1): rotation matrices of rotation vectors in radians."""
    a, b = _sine_over_angle((rotvec * rotvec).sum(-1, keepdim=True))
    x, y, z = rotvec.unbind(-1)
    ax, ay, az = (a * rotvec).unbind(-1)
    bx, by, bz = (b * rotvec).unbind(-1)
    xx, yy, zz, xy, xz, yz = bx * x, by * y, bz * z, bx * y, bx * z, by * z
    rows = [1 - yy - zz, xy - az, xz + ay, xy + az, 1 - xx - zz, yz - ax, xz - ay, yz + ax, 1 - xx - yy]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def left_jacobian(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """J with ``R(v + dv) = exp([J dv]x) R(v)`` to first order; singular at an angle of 2 pi: keep vectors wrapped."""
    squared = (rotvec * rotvec).sum(-1, keepdim=True)
    b, c = _sine_over_angle(squared)[1], _angle_less_sine(squared)
    skew = cross_matrix(rotvec)
    eye = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return eye + b[..., None] * skew + c[..., None] * (skew @ skew)


def rotvec_from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vectors with angles in [0, pi] of rotation matrices; accurate near 0 and near pi."""
    return rotvec_from_quaternion(quaternion_from_matrix(matrix))


def quaternion_from_rotvec(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation vectors in radians."""
    quarter = (rotvec * rotvec).sum(-1, keepdim=True) / 4
    sine_over_angle, versine = _sine_over_angle(quarter)
    return torch.cat([1 - quarter * versine, sine_over_angle * rotvec / 2], -1)


def rotvec_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vectors with angles in [0, pi] of quaternions of any length and sign."""
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    w, v = quaternion[..., :1], quaternion[..., 1:]
    squared = (v * v).sum(-1, keepdim=True)
    small = squared < 1e-2 * w * w
    ratio = torch.where(small, squared, torch.zeros_like(squared)) / torch.where(small, w, torch.ones_like(w)) ** 2
    series = torch.full_like(ratio, 1 / 17)
    for k in range(15, 0, -2):
        series = 1 / k - ratio * series
    n = torch.where(small, torch.ones_like(squared), squared).sqrt()
    near = 2 * series / torch.where(small, w, torch.ones_like(w))
    return v * torch.where(small, near, 2 * torch.atan2(n, w) / n)


def quaternion_from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation matrices: of four equal formulas, the one that divides by the largest number."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    squares = torch.stack([1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i], -1)
    rows = [
        torch.stack([squares[..., 0], h - f, c - g, d - b], -1),
        torch.stack([h - f, squares[..., 1], b + d, c + g], -1),
        torch.stack([c - g, b + d, squares[..., 2], f + h], -1),
        torch.stack([d - b, c + g, f + h, squares[..., 3]], -1),
    ]
    best = squares.argmax(-1, keepdim=True)
    chosen = torch.stack(rows, -2).gather(-2, best[..., None].expand(*best.shape, 4)).squeeze(-2)
    return chosen / (2 * squares.gather(-1, best).sqrt())


def matrix_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any length but zero."""
    w, x, y, z = quaternion.unbind(-1)
    s = 2 / (quaternion * quaternion).sum(-1)
    rows = [
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternion_multiply(p: Float[Tensor, "*#batch 4"], q: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The Hamilton product: first rotate by ``q``, then by ``p``."""
    a, b, c, d = p.unbind(-1)
    w, x, y, z = q.unbind(-1)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return torch.stack(parts, -1)


def quaternion_conjugate(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The inverse of a unit quaternion."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], -1)


def pure_quaternion(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """The quaternion (0, v) of a vector."""
    return torch.nn.functional.pad(vector, (1, 0))


def dual_quaternion_from_rigid(
    matrix: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 8"]:
    """Unit dual quaternions (real, dual) of rigid motions; the dual part is half (0, t) times the real part."""
    real = quaternion_from_matrix(matrix)
    return torch.cat([real, quaternion_multiply(pure_quaternion(translation), real) / 2], -1)


def rigid_from_dual_quaternion(
    dual_quaternion: Float[Tensor, "*batch 8"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """Rotation matrices and translations of dual quaternions, normalised first, so that blends may be passed."""
    real, dual = dual_quaternion[..., :4], dual_quaternion[..., 4:]
    moved = quaternion_multiply(dual, quaternion_conjugate(real))[..., 1:]
    return matrix_from_quaternion(real), 2 * moved / (real * real).sum(-1, keepdim=True)


def procrustes(
    source: Float[Tensor, "*batch N 3"],
    target: Float[Tensor, "*batch N 3"],
    weights: Float[Tensor, "*batch N"] | None = None,
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """The rotation R and translation t that minimise ``sum_i w_i |R source_i + t - target_i|^2`` (Kabsch 1976).

    ``weights`` are not negative and have a positive sum; a zero leaves the point out (its value must still be finite).
    R is a proper rotation even where a reflection would fit better.
    """
    if weights is None:
        weights = torch.ones_like(source[..., 0])
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    source_mean, target_mean = (share * source).sum(-2), (share * target).sum(-2)
    covariance = (share * (target - target_mean[..., None, :])).mT @ (source - source_mean[..., None, :])
    u, _, vh = torch.linalg.svd(covariance)
    sign = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0).to(u.dtype)
    u = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], -1)
    matrix = u @ vh
    return matrix, target_mean - (matrix @ source_mean[..., None]).squeeze(-1)
