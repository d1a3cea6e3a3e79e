"""Vectors and 3 x 3 matrices of lanes, as tuples (rows first), for compiled kernels; see
`habitus.kernels.simd`.
"""

import math

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.kernels.simd import load, nearest, root, spread, store, where_less

SERIES_TERMS = 13
"""Enough for angles of up to pi: the next term is below 1e-16 there."""
WHOLE = 2.0 * math.pi


@jit_inline
def load3(workspace, row):
    """The vector in rows row, row + 1, row + 2."""
    return load(workspace, row), load(workspace, row + 1), load(workspace, row + 2)


@jit_inline
def store3(workspace, row, v):
    """Write a vector to three rows."""
    store(workspace, row, v[0])
    store(workspace, row + 1, v[1])
    store(workspace, row + 2, v[2])


@jit_inline
def load9(workspace, row):
    """The matrix in nine rows."""
    a = load3(workspace, row)
    b = load3(workspace, row + 3)
    c = load3(workspace, row + 6)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@jit_inline
def store9(workspace, row, m):
    """Write a matrix to nine rows."""
    store3(workspace, row, (m[0], m[1], m[2]))
    store3(workspace, row + 3, (m[3], m[4], m[5]))
    store3(workspace, row + 6, (m[6], m[7], m[8]))


@jit_inline
def add3(p, q):
    """p + q."""
    return p[0] + q[0], p[1] + q[1], p[2] + q[2]


@jit_inline
def sub3(p, q):
    """p - q."""
    return p[0] - q[0], p[1] - q[1], p[2] - q[2]


@jit_inline
def scale3(a, p):
    """a p."""
    return a * p[0], a * p[1], a * p[2]


@jit_inline
def dot3(p, q):
    """p . q."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@jit_inline
def cross3(p, q):
    """p x q."""
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@jit_inline
def turn3(m, v):
    """m v."""
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
        m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
    )


@jit_inline
def turn_back3(m, v):
    """m^T v."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )


@jit_inline
def plus_turned_back3(total, m, v):
    """total + m^T v, each product added as it is made."""
    return (
        total[0] + m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        total[1] + m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        total[2] + m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )


@jit_inline
def product9(a, b):
    """a b."""
    x = turn_back3(b, (a[0], a[1], a[2]))
    y = turn_back3(b, (a[3], a[4], a[5]))
    z = turn_back3(b, (a[6], a[7], a[8]))
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]


@jit_inline
def unit3(v):
    """v / |v|."""
    return scale3(1.0 / root(dot3(v, v)), v)


@jit_inline
def rotation_and_jacobian9(v):
    """R = exp([v]x) and its left Jacobian for any v: R = I + A [v]x + B [v]x^2 and L = I + B [v]x +
    C [v]x^2.

    A = sin n / n, B = (1 - cos n) / n^2, C = (n - sin n) / n^3 by series in n^2 for n < 1; else sin
    n and cos n by series in the remainder of n by whole turns.
    """
    squared = dot3(v, v)
    angle = root(squared)
    rest = angle - WHOLE * nearest(angle * (1.0 / WHOLE))
    b, c = _series(rest * rest)
    sine = rest - rest * rest * rest * c
    versine = rest * rest * b
    small_b, small_c = _series(where_less(squared, 1.0, squared, 0.0))
    far = where_less(squared, 1.0, 1.0, squared)
    b = where_less(squared, 1.0, small_b, versine / far)
    c = where_less(
        squared,
        1.0,
        small_c,
        (angle - sine) / (far * angle + (1.0 - where_less(squared, 1.0, 0.0, 1.0))),
    )
    return _rodrigues(1.0 - squared * c, b, squared, v), _rodrigues(b, c, squared, v)


@jit_inline
def _series(squared):
    """(1 - cos n) / n^2 and (n - sin n) / n^3 of n^2, for n up to pi."""
    b = 1.0 + 0.0 * squared
    c = 1.0 + 0.0 * squared
    for k in range(SERIES_TERMS, 0, -1):
        b = 1.0 - b * squared * (1.0 / ((2 * k + 1) * (2 * k + 2)))
        c = 1.0 - c * squared * (1.0 / ((2 * k + 2) * (2 * k + 3)))
    return 0.5 * b, c * (1.0 / 6.0)


@jit_inline
def _rodrigues(a, b, squared, v):
    """I + a [v]x + b [v]x^2, with [v]x^2 = v v^T - |v|^2 I."""
    x, y, z = scale3(b, v)
    ax, ay, az = scale3(a, v)
    one = 1.0 - b * squared
    xy = x * v[1]
    xz = x * v[2]
    yz = y * v[2]
    return (
        one + x * v[0],
        xy - az,
        xz + ay,
        xy + az,
        one + y * v[1],
        yz - ax,
        xz - ay,
        yz + ax,
        one + z * v[2],
    )


@jit_noalloc
def block_row(r, c):
    """Where block (r, c) begins in the lower triangle of a symmetric matrix of 3 x 3 blocks, kept
    block after block.
    """
    return 9 * (r * (r + 1) // 2 + c)


@jit_inline
def spread3(workspace, x, y, z):
    """The same vector in every lane."""
    return spread(workspace, x), spread(workspace, y), spread(workspace, z)


@jit_inline
def along3(a, x, y, z):
    """a times the vector (x, y, z) of numbers."""
    return a * x, a * y, a * z


@jit_inline
def add_row3(workspace, row, v):
    """Add a vector to three rows."""
    store3(workspace, row, add3(load3(workspace, row), v))


@jit_inline
def clear(workspace, first, end):
    """Write zeros to the rows from `first` to before `end`."""
    for row in range(first, end):
        store(workspace, row, 0.0)
