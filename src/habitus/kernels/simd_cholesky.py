"""Cholesky of symmetric matrices of 3 x 3 blocks, one matrix per lane (`habitus.kernels.simd`).

Blocks of the lower triangle lie one after another, row by row, in an array (n, LANES)
(`simd_linalg.block_row`). The factor takes the matrix' place; its diagonal holds reciprocals.
"""

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.kernels.simd import root
from habitus.kernels.simd_linalg import (
    block_row,
    load3,
    load9,
    store3,
    store9,
    sub3,
    turn3,
    turn_back3,
)


@jit_noalloc
def factor(workspace, offset, blocks):
    """Overwrite the matrix of `blocks` x `blocks` blocks at row `at` with L, L L^T = matrix.

    Two rows of blocks at a time, which share what they read of the rows above.
    """
    for r in range(0, blocks, 2):
        last = min(r + 1, blocks - 1)
        for c in range(r):
            first = load9(workspace, offset + block_row(r, c))
            second = load9(workspace, offset + block_row(last, c))
            for k in range(c):
                above = load9(workspace, offset + block_row(c, k))
                first = _minus_product(first, load9(workspace, offset + block_row(r, k)), above)
                second = _minus_product(
                    second, load9(workspace, offset + block_row(last, k)), above
                )
            corner = load9(workspace, offset + block_row(c, c))
            store9(workspace, offset + block_row(r, c), _divided(first, corner))
            store9(workspace, offset + block_row(last, c), _divided(second, corner))
        for row in range(r, last + 1):
            for c in range(r, row + 1):
                finish_block(workspace, offset, row, c)


@jit_inline
def finish_block(workspace, offset, r, c):
    """Block (r, c) of the factor when all before it are known."""
    rest = load9(workspace, offset + block_row(r, c))
    for k in range(c):
        rest = _minus_product(
            rest,
            load9(workspace, offset + block_row(r, k)),
            load9(workspace, offset + block_row(c, k)),
        )
    done = (
        _divided(rest, load9(workspace, offset + block_row(c, c))) if c < r else _small_factor(rest)
    )
    store9(workspace, offset + block_row(r, c), done)


@jit_noalloc
def solve_factored(workspace, offset, blocks, right):
    """Overwrite the 3 `blocks` rows at row `right` with the solution of L L^T x = right."""
    for r in range(blocks):
        v = load3(workspace, right + 3 * r)
        for c in range(r):
            v = sub3(
                v,
                turn3(load9(workspace, offset + block_row(r, c)), load3(workspace, right + 3 * c)),
            )
        m = load9(workspace, offset + block_row(r, r))
        x = v[0] * m[0]
        y = (v[1] - m[3] * x) * m[4]
        store3(workspace, right + 3 * r, (x, y, (v[2] - m[6] * x - m[7] * y) * m[8]))
    for r in range(blocks - 1, -1, -1):
        v = load3(workspace, right + 3 * r)
        m = load9(workspace, offset + block_row(r, r))
        z = v[2] * m[8]
        y = (v[1] - m[7] * z) * m[4]
        solved = ((v[0] - m[3] * y - m[6] * z) * m[0], y, z)
        store3(workspace, right + 3 * r, solved)
        for c in range(r):
            rest = load3(workspace, right + 3 * c)
            store3(
                workspace,
                right + 3 * c,
                sub3(rest, turn_back3(load9(workspace, offset + block_row(r, c)), solved)),
            )


@jit_inline
def _minus_product(m, a, b):
    """m - a b^T, each product taken away as it is made."""
    x = _minus_turned(m[0], m[1], m[2], b, a[0], a[1], a[2])
    y = _minus_turned(m[3], m[4], m[5], b, a[3], a[4], a[5])
    z = _minus_turned(m[6], m[7], m[8], b, a[6], a[7], a[8])
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]


@jit_inline
def _minus_turned(x, y, z, m, a, b, c):
    """(x, y, z) - m (a, b, c)."""
    return (
        x - m[0] * a - m[1] * b - m[2] * c,
        y - m[3] * a - m[4] * b - m[5] * c,
        z - m[6] * a - m[7] * b - m[8] * c,
    )


@jit_inline
def _divided(m, factor):
    """m L^-T for a factored diagonal block."""
    x = _row_divided(m[0], m[1], m[2], factor)
    y = _row_divided(m[3], m[4], m[5], factor)
    z = _row_divided(m[6], m[7], m[8], factor)
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]


@jit_inline
def _row_divided(x, y, z, factor):
    x = x * factor[0]
    y = (y - x * factor[3]) * factor[4]
    return x, y, (z - x * factor[6] - y * factor[7]) * factor[8]


@jit_inline
def _small_factor(m):
    """Cholesky of a 3 x 3 matrix, reciprocals on the diagonal."""
    zero = 0.0 * m[0]
    x = 1.0 / root(m[0])
    yx = m[3] * x
    zx = m[6] * x
    y = 1.0 / root(m[4] - yx * yx)
    zy = (m[7] - zx * yx) * y
    return x, zero, zero, yx, y, zero, zx, zy, 1.0 / root(m[8] - zx * zx - zy * zy)
