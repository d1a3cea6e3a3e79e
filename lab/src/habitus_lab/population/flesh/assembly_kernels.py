"""Sums over tetrahedra: energy, forces and the block matrix of second derivatives, and products
with that matrix.
"""

import numpy as np

from habitus.kernels.jit import jit
from habitus_lab.population.flesh.elastic_kernels import (
    energy_density,
    gradient_of,
    modes_of,
    rotations_of,
)


@jit
def total_energy(nodes, tets, inverse, volume, mu, lam):
    """Elastic energy; the inverses of the rest edges (T, 3, 3) may be stretched by active
    muscles.
    """
    f = np.empty((3, 3))
    total = 0.0
    for t in range(len(tets)):
        det = gradient_of(nodes, tets[t], inverse[t], f)
        total += volume[t] * energy_density(f, det, mu[t], lam[t])
    return total


@jit
def determinants(nodes, tets, inverse, out):
    """J of each tetrahedron."""
    f = np.empty((3, 3))
    for t in range(len(tets)):
        out[t] = gradient_of(nodes, tets[t], inverse[t], f)


@jit
def add_elastic(nodes, tets, inverse, volume, mu, lam, slots, gradient, blocks):
    """Add the energy's derivatives to gradient (N, 3), and to blocks (K, 3, 3) where slots (T, 16)
    are not negative.
    """
    f = np.empty((3, 3))
    u = np.empty((3, 3))
    v = np.empty((3, 3))
    square = np.empty((3, 3))
    work = np.empty((3, 3))
    vectors = np.empty((3, 3))
    stretch = np.empty((3, 3))
    shear = np.empty((3, 2))
    sigma = np.empty(3)
    force = np.empty((3, 3))
    rest = np.empty((3, 3))
    local = np.empty((3, 3))
    half = np.empty((3, 3))
    element = np.empty((4, 4, 3, 3))
    for t in range(len(tets)):
        gradient_of(nodes, tets[t], inverse[t], f)
        rotations_of(f, u, sigma, v, square)
        first = modes_of(sigma, mu[t], lam[t], stretch, shear, work, vectors)
        _forces(f, u, sigma, v, first, mu[t], inverse[t], force)
        for c in range(3):
            total = 0.0
            for a in range(3):
                gradient[tets[t, a + 1], c] += volume[t] * force[a, c]
                total += force[a, c]
            gradient[tets[t, 0], c] -= volume[t] * total
        for a in range(3):
            for k in range(3):
                rest[a, k] = (
                    inverse[t, a, 0] * v[0, k]
                    + inverse[t, a, 1] * v[1, k]
                    + inverse[t, a, 2] * v[2, k]
                )
        _element(u, rest, stretch, shear, volume[t], local, half, element)
        _scatter(element, slots[t], blocks)


@jit
def _forces(f, u, sigma, v, first, mu, inverse, force):
    """Rows a: derivative of the density by the corner a + 1."""
    for a in range(3):
        for c in range(3):
            total = 0.0
            for j in range(3):
                stress = mu * f[c, j]
                for k in range(3):
                    stress += first * u[c, k] * sigma[(k + 1) % 3] * sigma[(k + 2) % 3] * v[j, k]
                total += stress * inverse[a, j]
            force[a, c] = total


@jit
def _element(u, rest, stretch, shear, volume, local, half, element):
    """Blocks (4, 4, 3, 3) between the corners, those of the first from the others, as moving all
    does nothing.
    """
    for a in range(1, 4):
        for b in range(a, 4):
            ra = rest[a - 1]
            rb = rest[b - 1]
            for i in range(3):
                j = (i + 1) % 3
                k = (i + 2) % 3
                own = (
                    stretch[i, i] * ra[i] * rb[i]
                    + shear[k, 0] * ra[j] * rb[j]
                    + shear[j, 0] * ra[k] * rb[k]
                )
                local[i, i] = volume * own
                local[i, j] = volume * (stretch[i, j] * ra[i] * rb[j] + shear[k, 1] * ra[j] * rb[i])
                local[j, i] = volume * (stretch[i, j] * ra[j] * rb[i] + shear[k, 1] * ra[i] * rb[j])
            for i in range(3):
                for j in range(3):
                    half[i, j] = (
                        u[i, 0] * local[0, j] + u[i, 1] * local[1, j] + u[i, 2] * local[2, j]
                    )
            for i in range(3):
                for j in range(3):
                    value = half[i, 0] * u[j, 0] + half[i, 1] * u[j, 1] + half[i, 2] * u[j, 2]
                    element[a, b, i, j] = value
                    element[b, a, j, i] = value
    for i in range(3):
        for j in range(3):
            for a in range(1, 4):
                element[a, 0, i, j] = (
                    -element[a, 1, i, j] - element[a, 2, i, j] - element[a, 3, i, j]
                )
                element[0, a, j, i] = element[a, 0, i, j]
    for i in range(3):
        for j in range(3):
            element[0, 0, i, j] = -element[1, 0, i, j] - element[2, 0, i, j] - element[3, 0, i, j]


@jit
def _scatter(element, slots, blocks):
    for a in range(4):
        for b in range(4):
            slot = slots[4 * a + b]
            if slot >= 0:
                for i in range(3):
                    for j in range(3):
                        blocks[slot, i, j] += element[a, b, i, j]


@jit
def add_springs(corners, weights, stiffness, slots, blocks):
    """Add springs on points in tetrahedra, weights (S, 4) of their corners, to the matrix: constant
    blocks.
    """
    for s in range(len(corners)):
        for a in range(4):
            for b in range(4):
                slot = slots[s, 4 * a + b]
                if slot >= 0:
                    value = stiffness[s] * weights[s, a] * weights[s, b]
                    for i in range(3):
                        blocks[slot, i, i] += value


@jit
def spring_energy(nodes, corners, weights, stiffness, targets, gradient):
    """Energy of the springs towards targets (S, 3); their forces are added to the gradient (N,
    3).
    """
    total = 0.0
    for s in range(len(corners)):
        for c in range(3):
            off = -targets[s, c]
            for a in range(4):
                off += weights[s, a] * nodes[corners[s, a], c]
            total += 0.5 * stiffness[s] * off * off
            for a in range(4):
                gradient[corners[s, a], c] += stiffness[s] * weights[s, a] * off
    return total


@jit
def multiply(starts, columns, blocks, x, out):
    """out (N, 3) = A x for blocks (K, 3, 3) in rows of compressed storage."""
    for r in range(len(starts) - 1):
        a = b = c = 0.0
        for k in range(starts[r], starts[r + 1]):
            m = blocks[k]
            n = columns[k]
            x0 = x[n, 0]
            x1 = x[n, 1]
            x2 = x[n, 2]
            a += m[0, 0] * x0 + m[0, 1] * x1 + m[0, 2] * x2
            b += m[1, 0] * x0 + m[1, 1] * x1 + m[1, 2] * x2
            c += m[2, 0] * x0 + m[2, 1] * x1 + m[2, 2] * x2
        out[r, 0], out[r, 1], out[r, 2] = a, b, c


@jit
def multiply_contacts(corners, coefficients, normals, stiffness, active, x, out):
    """Add to out what contacts do: 8 corners each, of which those beyond x are held."""
    free = len(x)
    for k in range(len(corners)):
        if not active[k]:
            continue
        along = 0.0
        for a in range(8):
            n = corners[k, a]
            if n < free:
                dot = normals[k, 0] * x[n, 0] + normals[k, 1] * x[n, 1] + normals[k, 2] * x[n, 2]
                along += coefficients[k, a] * dot
        along *= stiffness
        for a in range(8):
            n = corners[k, a]
            if n < free:
                for i in range(3):
                    out[n, i] += along * coefficients[k, a] * normals[k, i]


@jit
def contact_energy(nodes, corners, coefficients, normals, stiffness, gap, active, gradient):
    """Energy of unilateral springs that keep `gap` along the normals; marks the active, adds forces
    to the gradient.
    """
    total = 0.0
    for k in range(len(corners)):
        distance = -gap
        for a in range(8):
            n = corners[k, a]
            for i in range(3):
                distance += coefficients[k, a] * normals[k, i] * nodes[n, i]
        active[k] = distance < 0
        if distance < 0:
            total += 0.5 * stiffness * distance * distance
            for a in range(8):
                for i in range(3):
                    gradient[corners[k, a], i] += (
                        stiffness * distance * coefficients[k, a] * normals[k, i]
                    )
    return total


@jit
def add_contact_diagonal(corners, coefficients, normals, stiffness, active, diagonal):
    """Add the contacts' part to the diagonal blocks (N, 3, 3) of free nodes."""
    for k in range(len(corners)):
        if active[k]:
            for a in range(8):
                n = corners[k, a]
                if n < len(diagonal):
                    value = stiffness * coefficients[k, a] ** 2
                    for i in range(3):
                        for j in range(3):
                            diagonal[n, i, j] += value * normals[k, i] * normals[k, j]


@jit
def invert_blocks(diagonal):
    """Invert symmetric positive blocks (N, 3, 3) in place."""
    for n in range(len(diagonal)):
        m = diagonal[n]
        a = m[0, 0]
        b = m[0, 1]
        c = m[0, 2]
        d = m[1, 1]
        e = m[1, 2]
        f = m[2, 2]
        p = d * f - e * e
        q = c * e - b * f
        r = b * e - c * d
        det = a * p + b * q + c * r
        m[0, 0], m[1, 1], m[2, 2] = p / det, (a * f - c * c) / det, (a * d - b * b) / det
        m[0, 1] = m[1, 0] = q / det
        m[0, 2] = m[2, 0] = r / det
        m[1, 2] = m[2, 1] = (b * c - a * e) / det


@jit
def conjugate_gradients(
    starts, columns, blocks, inverse, contacts, stiffness, right, x, tolerance, most
):
    """Solve A x = right (N, 3) from x = 0 with the inverted diagonal; gives the number of steps
    taken.

    Stops where the residual in the preconditioner's norm has fallen by `tolerance`.
    """
    corners, coefficients, normals, active = contacts
    count = len(right)
    r = right.copy()
    z = np.empty_like(right)
    p = np.zeros_like(right)
    q = np.empty_like(right)
    x[:] = 0.0
    last = 1.0
    begin = 0.0
    for step in range(most + 1):
        rho = 0.0
        for n in range(count):
            for i in range(3):
                z[n, i] = (
                    inverse[n, i, 0] * r[n, 0]
                    + inverse[n, i, 1] * r[n, 1]
                    + inverse[n, i, 2] * r[n, 2]
                )
                rho += z[n, i] * r[n, i]
        if step == 0:
            begin = rho
        if step == most or rho <= tolerance * tolerance * begin:
            return step
        beta = rho / last if step else 0.0
        for n in range(count):
            for i in range(3):
                p[n, i] = z[n, i] + beta * p[n, i]
        multiply(starts, columns, blocks, p, q)
        multiply_contacts(corners, coefficients, normals, stiffness, active, p, q)
        curvature = 0.0
        for n in range(count):
            for i in range(3):
                curvature += p[n, i] * q[n, i]
        if curvature <= 0.0:
            return step
        alpha = rho / curvature
        for n in range(count):
            for i in range(3):
                x[n, i] += alpha * p[n, i]
                r[n, i] -= alpha * q[n, i]
        last = rho
    return most
