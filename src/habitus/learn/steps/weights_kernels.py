"""Compiled loops over vertices for skinning weights: influence of candidate joints, best sparse
weights.
"""

import numpy as np

from habitus.kernels.jit import jit, jit_inline
from habitus.learn.posing.quaternions import blend, conjugate, dot4, product


@jit
def linear_influences(candidates, rest, motions):
    """Posed positions of each vertex under each candidate joint alone (V,C,3)."""
    out = np.empty((len(rest), candidates.shape[1], 3))
    for v in range(len(rest)):
        x = rest[v, 0]
        y = rest[v, 1]
        z = rest[v, 2]
        for c in range(candidates.shape[1]):
            m = motions[candidates[v, c]]
            for a in range(3):
                out[v, c, a] = m[a, 0] * x + m[a, 1] * y + m[a, 2] * z + m[a, 3]
    return out


@jit
def dual_influences(index, signed, candidates, sides, rest, moved, quaternions, translations):
    """Derivative of each vertex by each candidate's weight with dual quaternions (V,C,3).

    dx = 2/|b|^2 [vec(b' y b*) + vec(e b'*) - x (b . b') + vec(e' b*)] with b' and e' the
    candidate's own parts.
    """
    out = np.empty((len(rest), candidates.shape[1], 3))
    for v in range(len(rest)):
        b = blend(index[v], signed[v], quaternions)
        e = (0.0, 0.0, 0.0, 0.0)
        for k in range(index.shape[1]):
            d = _dual(quaternions, translations, index[v, k], signed[v, k])
            e = (e[0] + d[0], e[1] + d[1], e[2] + d[2], e[3] + d[3])
        back = conjugate(b)
        turned = product((0.0, rest[v, 0], rest[v, 1], rest[v, 2]), back)
        f = 2.0 / dot4(b, b)
        for c in range(candidates.shape[1]):
            joint = candidates[v, c]
            side = sides[v, c]
            q = (
                side * quaternions[joint, 0], side * quaternions[joint, 1],
                side * quaternions[joint, 2], side * quaternions[joint, 3],
            )  # fmt: skip
            first = product(q, turned)
            second = product(e, conjugate(q))
            third = product(_dual(quaternions, translations, joint, side), back)
            along = dot4(b, q)
            for a in range(3):
                out[v, c, a] = f * (
                    first[a + 1] + second[a + 1] + third[a + 1] - moved[v, a] * along
                )
    return out


@jit_inline
def _dual(quaternions, translations, joint, factor):
    q = (
        factor * quaternions[joint, 0], factor * quaternions[joint, 1],
        factor * quaternions[joint, 2], factor * quaternions[joint, 3],
    )  # fmt: skip
    return product(
        (
            0.0,
            0.5 * translations[joint, 0],
            0.5 * translations[joint, 1],
            0.5 * translations[joint, 2],
        ),
        q,
    )


@jit
def best_weights(matrix, vector, may, supports):
    """Per vertex the w >= 0 of sum 1 that minimises w M w - 2 m w over all supports (candidates'
    numbers, -1 fills).

    On a support the minimum under sum(w) = 1 is x + t y with M x = m, M y = 1; it counts where no
    weight is negative.
    """
    vertices, count = vector.shape
    out = np.zeros((vertices, count))
    size = supports.shape[1]
    factor = np.empty((size, size))
    x = np.empty(size)
    y = np.empty(size)
    for v in range(vertices):
        best = np.inf
        for s in range(len(supports)):
            n = 0
            while n < size and supports[s, n] >= 0 and may[v, supports[s, n]]:
                n += 1
            if n == 0 or (n < size and supports[s, n] >= 0):
                continue
            if not _solve(matrix[v], vector[v], supports[s], n, factor, x, y):
                continue
            sum_x = sum_y = 0.0
            for i in range(n):
                sum_x += x[i]
                sum_y += y[i]
            t = (1.0 - sum_x) / sum_y
            energy = 0.0
            feasible = True
            for i in range(n):
                x[i] += t * y[i]
                feasible = feasible and x[i] >= 0.0
            if not feasible:
                continue
            for i in range(n):
                row = supports[s, i]
                for j in range(n):
                    energy += x[i] * matrix[v, row, supports[s, j]] * x[j]
                energy -= 2.0 * vector[v, row] * x[i]
            if energy < best:
                best = energy
                for c in range(count):
                    out[v, c] = 0.0
                for i in range(n):
                    out[v, supports[s, i]] = x[i]
    return out


@jit_inline
def _solve(matrix, vector, support, n, factor, x, y):
    """Cholesky on the support: matrix x = vector, matrix y = 1; False where it is not positive
    definite.
    """
    for i in range(n):
        for j in range(i + 1):
            total = matrix[support[i], support[j]]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if total <= 1e-14 * matrix[support[i], support[i]]:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(n):
        a = vector[support[i]]
        b = 1.0
        for k in range(i):
            a -= factor[i, k] * x[k]
            b -= factor[i, k] * y[k]
        x[i], y[i] = a / factor[i, i], b / factor[i, i]
    for i in range(n - 1, -1, -1):
        a = x[i]
        b = y[i]
        for k in range(i + 1, n):
            a -= factor[k, i] * x[k]
            b -= factor[k, i] * y[k]
        x[i], y[i] = a / factor[i, i], b / factor[i, i]
    return True
