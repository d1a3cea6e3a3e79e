"""Stable neo-Hookean tetrahedra (Smith, de Goes, Kim 2018): energy, forces, Hessians whose negative
modes are dropped.

A tetrahedron of rest volume v and stiffness mu and lambda, with F the gradient of its deformation
and J = det F, has

    v (mu/2 (|F|^2 - 3) - mu (J - 1) + lambda/2 (J - 1)^2 + guard/2 max(0, J0 - J)^2).

The last term turns flattened and inverted elements around. Modes are analytic: with F = U S V' the
second derivative of J couples M_ij and M_ji of M = U' dF V by the third singular value, and the
three M_ii among each other.
"""

from habitus.kernels.jit import jit

GUARD = 200.0
"""Stiffness against J below `FLAT`, in units of mu."""
FLAT = 0.35
SWEEPS = 12


@jit
def gradient_of(nodes, tet, inverse, f):
    """F (3, 3) of one tetrahedron from its corners and the inverse of its rest edges; gives its
    determinant.
    """
    for i in range(3):
        o = nodes[tet[0], i]
        a = nodes[tet[1], i] - o
        b = nodes[tet[2], i] - o
        c = nodes[tet[3], i] - o
        for j in range(3):
            f[i, j] = a * inverse[0, j] + b * inverse[1, j] + c * inverse[2, j]
    return (
        f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
        - f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
        + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
    )


@jit
def energy_density(f, det, mu, lam):
    """Energy per rest volume."""
    square = 0.0
    for i in range(3):
        for j in range(3):
            square += f[i, j] * f[i, j]
    flat = max(0.0, FLAT - det)
    return (
        0.5 * mu * (square - 3)
        - mu * (det - 1)
        + 0.5 * lam * (det - 1) ** 2
        + 0.5 * GUARD * mu * flat * flat
    )


@jit
def jacobi(a, v):
    """Diagonalise the symmetric a (3, 3) in place, a -> v' a v; columns of v are its
    eigenvectors.
    """
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        off = abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2])
        if off <= 1e-14 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
                t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + (theta * theta + 1) ** 0.5)
                c = 1 / (t * t + 1) ** 0.5
                s = t * c
                r = 3 - p - q
                shift = t * a[p, q]
                a[p, p] -= shift
                a[q, q] += shift
                a[p, q] = a[q, p] = 0.0
                x = a[r, p]
                y = a[r, q]
                a[r, p] = a[p, r] = c * x - s * y
                a[r, q] = a[q, r] = s * x + c * y
                for k in range(3):
                    x = v[k, p]
                    y = v[k, q]
                    v[k, p] = c * x - s * y
                    v[k, q] = s * x + c * y


@jit
def rotations_of(f, u, sigma, v, square):
    """F = U diag(sigma) V' with rotations U, V: the smallest sigma carries the sign of the
    determinant.
    """
    for i in range(3):
        for j in range(3):
            square[i, j] = f[0, i] * f[0, j] + f[1, i] * f[1, j] + f[2, i] * f[2, j]
    jacobi(square, v)
    first = 0
    last = 0
    for k in range(1, 3):
        if square[k, k] > square[first, first]:
            first = k
        if square[k, k] <= square[last, last]:
            last = k
    if first == last:
        last = (first + 2) % 3
    middle = 3 - first - last
    _as_rotation(v)
    _unit_column(f, v, u, first)
    _unit_column(f, v, u, middle)
    dot = u[0, first] * u[0, middle] + u[1, first] * u[1, middle] + u[2, first] * u[2, middle]
    for i in range(3):
        u[i, middle] -= dot * u[i, first]
    _normalise(u, middle, first)
    sign = 1.0 if (middle - first) % 3 == 1 else -1.0
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        u[i, last] = sign * (u[j, first] * u[k, middle] - u[k, first] * u[j, middle])
    for c in range(3):
        total = 0.0
        for i in range(3):
            total += u[i, c] * (f[i, 0] * v[0, c] + f[i, 1] * v[1, c] + f[i, 2] * v[2, c])
        sigma[c] = total


@jit
def _as_rotation(v):
    det = (
        v[0, 0] * (v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1])
        - v[0, 1] * (v[1, 0] * v[2, 2] - v[1, 2] * v[2, 0])
        + v[0, 2] * (v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0])
    )
    if det < 0:
        for i in range(3):
            v[i, 2] = -v[i, 2]


@jit
def _unit_column(f, v, u, c):
    for i in range(3):
        u[i, c] = f[i, 0] * v[0, c] + f[i, 1] * v[1, c] + f[i, 2] * v[2, c]
    length = (u[0, c] ** 2 + u[1, c] ** 2 + u[2, c] ** 2) ** 0.5
    for i in range(3):
        u[i, c] = u[i, c] / length if length > 1e-200 else (1.0 if i == c else 0.0)


@jit
def _normalise(u, c, other):
    length = (u[0, c] ** 2 + u[1, c] ** 2 + u[2, c] ** 2) ** 0.5
    if length > 1e-12:
        for i in range(3):
            u[i, c] /= length
        return
    least = 0  # a line: any direction across it
    for i in range(1, 3):
        if abs(u[i, other]) < abs(u[least, other]):
            least = i
    j = (least + 1) % 3
    k = (least + 2) % 3
    root = (u[j, other] ** 2 + u[k, other] ** 2) ** 0.5
    u[least, c], u[j, c], u[k, c] = 0.0, -u[k, other] / root, u[j, other] / root


@jit
def modes_of(sigma, mu, lam, stretch, shear, work, vectors):
    """Second derivative in the frame of the singular values, negative modes dropped: gives dpsi/dJ
    - and fills

    stretch (3, 3) among M_ii, and shear (3, 2): what M_ij^2 + M_ji^2 and 2 M_ij M_ji weigh, by the
    third axis.
    """
    det = sigma[0] * sigma[1] * sigma[2]
    flat = max(0.0, FLAT - det)
    first = -mu + lam * (det - 1) - GUARD * mu * flat
    second = lam + (GUARD * mu if flat > 0 else 0.0)
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        even = max(0.0, mu - first * sigma[k])
        odd = max(0.0, mu + first * sigma[k])
        shear[k, 0], shear[k, 1] = 0.5 * (even + odd), 0.5 * (even - odd)
        other = sigma[i] * sigma[j]
        work[k, k] = mu + second * other * other
        cross = second * sigma[j] * sigma[k] * sigma[i] * sigma[k] + first * sigma[k]
        work[i, j] = work[j, i] = cross
    jacobi(work, vectors)
    for i in range(3):
        for j in range(3):
            total = 0.0
            for c in range(3):
                total += vectors[i, c] * max(0.0, work[c, c]) * vectors[j, c]
            stretch[i, j] = total
    return first
