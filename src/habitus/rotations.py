"""Rotations in the forms a body needs: vectors, matrices, quaternions, dual quaternions, and the
best rigid fit.

All functions are batched over leading axes, take NumPy arrays or torch tensors (float32 or float64)
and answer in kind. In torch they have finite first and second derivatives at the zero rotation:
near it, power series in the squared angle replace the closed forms.

A rotation vector is axis times angle in radians (S 3, eq. 1). Quaternions are (w, x, y, z). Rigid
motions map ``x`` to ``R x + t``.
"""

import numpy as np
from jaxtyping import Float

from habitus.arrays import cast, eye, namespace, take_along, unbind
from habitus.types import Array

# squared angle (rad^2); eight terms leave less than one unit in the last place of float64 there
_SERIES_BELOW = 0.5


def _series(x: Array, first: float, n: int) -> Array:
    """Eight terms of the power series in x from ``first`` on; each next is -x / ((n + 1) (n + 2))
    times the last.
    """
    coefficients = [first]
    for k in range(n, n + 14, 2):
        coefficients.append(-coefficients[-1] / ((k + 1) * (k + 2)))
    total = x * coefficients[-1] + coefficients[-2]
    for coefficient in reversed(coefficients[:-2]):
        total = total * x + coefficient
    return total


def _near_and_far(squared: Array) -> tuple[Array, Array, Array]:
    """Where the series hold; the squared angles for them; and those for the closed forms, kept away
    from zero.
    """
    small = squared < _SERIES_BELOW
    xp = namespace(squared)
    return small, xp.where(small, squared, 0.0), xp.where(small, 1.0, squared)


def _sine_over_angle(squared: Array) -> tuple[Array, Array]:
    """sin n / n and (1 - cos n) / n^2 as smooth functions of n^2."""
    xp = namespace(squared)
    small, near, far = _near_and_far(squared)
    n = xp.sqrt(far)
    half = xp.sin(n / 2)
    return xp.where(small, _series(near, 1.0, 1), xp.sin(n) / n), xp.where(
        small, _series(near, 0.5, 2), 2 * half * half / far
    )


def _angle_less_sine(squared: Array) -> Array:
    """(n - sin n) / n^3 as a smooth function of n^2."""
    small, near, far = _near_and_far(squared)
    xp = namespace(squared)
    n = xp.sqrt(far)
    return xp.where(small, _series(near, 1 / 6, 3), (n - xp.sin(n)) / (far * n))


def _matrices(entries: list[Array]) -> Array:
    """Matrices 3 x 3 from their nine entries, rows first."""
    stacked = namespace(*entries).stack(entries, -1)
    return stacked.reshape(*stacked.shape[:-1], 3, 3)


def cross_matrix(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """The matrix ``[v]x`` with ``[v]x u = v x u``."""
    x, y, z = unbind(vector)
    zero = namespace(x).zeros_like(x)
    return _matrices([zero, -z, y, z, zero, -x, -y, x, zero])


def matrix_from_rotvec(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rodrigues' formula (S 3, eq. 1): rotation matrices of rotation vectors in radians."""
    a, b = _sine_over_angle((rotvec * rotvec).sum(-1)[..., None])
    x, y, z = unbind(rotvec)
    ax, ay, az = unbind(a * rotvec)
    bx, by, bz = unbind(b * rotvec)
    xx = bx * x
    yy = by * y
    zz = bz * z
    xy = bx * y
    xz = bx * z
    yz = by * z
    rows = [
        1 - yy - zz,
        xy - az,
        xz + ay,
        xy + az,
        1 - xx - zz,
        yz - ax,
        xz - ay,
        yz + ax,
        1 - xx - yy,
    ]
    return _matrices(rows)


def left_jacobian(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """J with ``R(v + dv) = exp([J dv]x) R(v)`` to first order; singular at an angle of 2 pi: keep
    vectors wrapped.
    """
    squared = (rotvec * rotvec).sum(-1)[..., None]
    b = _sine_over_angle(squared)[1]
    c = _angle_less_sine(squared)
    skew = cross_matrix(rotvec)
    return eye(3, rotvec) + b[..., None] * skew + c[..., None] * (skew @ skew)


def rotvec_from_matrix(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Rotation vectors with angles in [0, pi] of rotation matrices; accurate near 0 and near pi."""
    return rotvec_from_quaternion(quaternion_from_matrix(matrix))


def quaternion_from_rotvec(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Unit quaternions of rotation vectors in radians."""
    quarter = (rotvec * rotvec).sum(-1)[..., None] / 4
    sine_over_angle, versine = _sine_over_angle(quarter)
    return namespace(rotvec).concatenate([1 - quarter * versine, sine_over_angle * rotvec / 2], -1)


def rotvec_from_quaternion(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3"]:
    """Rotation vectors with angles in [0, pi] of quaternions of any length and sign."""
    xp = namespace(quaternion)
    quaternion = xp.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    w = quaternion[..., :1]
    v = quaternion[..., 1:]
    squared = (v * v).sum(-1)[..., None]
    small = squared < 1e-2 * w * w
    near_w = xp.where(small, w, 1.0)
    ratio = xp.where(small, squared, 0.0) / near_w**2
    series = 1 / 17
    for k in range(15, 0, -2):
        series = 1 / k - ratio * series
    n = xp.sqrt(xp.where(small, 1.0, squared))
    return v * xp.where(small, 2 * series / near_w, 2 * xp.atan2(n, w) / n)


def quaternion_from_matrix(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 4"]:
    """Unit quaternions of rotation matrices: of four equal formulas, the one that divides by the
    largest number.
    """
    (a, b, c), (d, e, f), (g, h, i) = (unbind(row) for row in unbind(matrix, -2))
    xp = namespace(matrix)
    squares = xp.stack([1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i], -1)
    rows = [
        xp.stack([squares[..., 0], h - f, c - g, d - b], -1),
        xp.stack([h - f, squares[..., 1], b + d, c + g], -1),
        xp.stack([c - g, b + d, squares[..., 2], f + h], -1),
        xp.stack([d - b, c + g, f + h, squares[..., 3]], -1),
    ]
    best = squares.argmax(-1)[..., None]
    index = xp.broadcast_to(best[..., None], (*best.shape, 4))
    chosen = take_along(xp.stack(rows, -2), index, -2)[..., 0, :]
    return chosen / (2 * xp.sqrt(take_along(squares, best, -1)))


def matrix_from_quaternion(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices of quaternions of any length but zero."""
    w, x, y, z = unbind(quaternion)
    s = 2 / (quaternion * quaternion).sum(-1)
    rows = [
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    ]  # fmt: skip
    return _matrices(rows)


def quaternion_multiply(
    p: Float[Array, "*#batch 4"], q: Float[Array, "*#batch 4"]
) -> Float[Array, "*batch 4"]:
    """The Hamilton product: first rotate by ``q``, then by ``p``."""
    a, b, c, d = unbind(p)
    w, x, y, z = unbind(q)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return namespace(p, q).stack(parts, -1)


def quaternion_conjugate(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """The inverse of a unit quaternion."""
    return namespace(quaternion).concatenate([quaternion[..., :1], -quaternion[..., 1:]], -1)


def pure_quaternion(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """The quaternion (0, v) of a vector."""
    xp = namespace(vector)
    return xp.concatenate([xp.zeros_like(vector[..., :1]), vector], -1)


def dual_quaternion_from_rigid(
    matrix: Float[Array, "*batch 3 3"], translation: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 8"]:
    """Unit dual quaternions (real, dual) of rigid motions; the dual part is half (0, t) times the
    real part.
    """
    real = quaternion_from_matrix(matrix)
    return namespace(real).concatenate(
        [real, quaternion_multiply(pure_quaternion(translation), real) / 2], -1
    )


def rigid_from_dual_quaternion(
    dual_quaternion: Float[Array, "*batch 8"],
) -> tuple[Float[Array, "*batch 3 3"], Float[Array, "*batch 3"]]:
    """Rotation matrices and translations of dual quaternions, normalised first, so that blends may
    be passed.
    """
    real = dual_quaternion[..., :4]
    dual = dual_quaternion[..., 4:]
    moved = quaternion_multiply(dual, quaternion_conjugate(real))[..., 1:]
    return matrix_from_quaternion(real), 2 * moved / (real * real).sum(-1)[..., None]


def procrustes(
    source: Float[Array, "*batch N 3"],
    target: Float[Array, "*batch N 3"],
    weights: Float[Array, "*batch N"] | None = None,
) -> tuple[Float[Array, "*batch 3 3"], Float[Array, "*batch 3"]]:
    """The rotation R and translation t that minimise ``sum_i w_i |R source_i + t - target_i|^2``
    (Kabsch 1976).

    ``weights`` are not negative and have a positive sum; a zero leaves the point out (its value
    must still be finite). R is a proper rotation even where a reflection would fit better.
    """
    xp = namespace(source)
    share: Array = xp.ones_like(source[..., 0]) if weights is None else weights
    share = (share / share.sum(-1)[..., None])[..., None]
    source_mean = (share * source).sum(-2)
    target_mean = (share * target).sum(-2)
    covariance = (share * (target - target_mean[..., None, :])).mT @ (
        source - source_mean[..., None, :]
    )
    u, _, vh = xp.linalg.svd(covariance)
    sign = 1 - 2 * cast(xp.linalg.det(u @ vh) < 0, u)
    u = xp.concatenate([u[..., :2], u[..., 2:] * sign[..., None, None]], -1)
    matrix = u @ vh
    return matrix, target_mean - (matrix @ source_mean[..., None])[..., 0]


UP_AXES = {
    "+x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "+y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def up_rotation(up_axis: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes a capture's own world to one whose +y is up; ``up_axis`` is "+z",
    "y", "-x", …
    """
    signed = signed_axis(up_axis)
    if signed is None:
        raise KeyError(up_axis)
    return np.array(UP_AXES[signed], dtype=np.float64)


def signed_axis(text: str | None) -> str | None:
    """An axis in any spelling ("Y", "+y", "-Z ") as "+y"; None where it names no axis."""
    word = (text or "").strip().lower()
    signed = word if word[:1] in ("+", "-") else f"+{word}"
    return signed if signed in UP_AXES else None
