"""Normal equations of a frame's own terms, for LANES frames at once: markers, and a Gaussian over
all unknowns.

Implements the terms "data", "pose" and "soft_tissue" of `habitus.fit.markers.energy`.

    f = 1/2 l_D sum_i w_i rho_i(|x_i - m_i|^2) + 1/2 (z - mean)^T precision (z - mean)

Geman-McClure's rho = s^2 d^2 / (s^2 + d^2) enters the matrix by its re-weighted square, rho' = (s^2
/ (s^2 + d^2))^2.
"""

from habitus.kernels.jit import jit_inline
from habitus.kernels.simd import load, root, spread, store
from habitus.kernels.simd_linalg import (
    add3,
    add_row3,
    along3,
    block_row,
    clear,
    dot3,
    load3,
    load9,
    plus_turned_back3,
    scale3,
    spread3,
    store3,
    store9,
    sub3,
    turn_back3,
)
from habitus.observe.marker_jacobian_kernels import (
    write_columns,
    write_hinge_turns,
    write_shape_jacobian,
)
from habitus.observe.marker_kernels import place_markers


@jit_inline
def frame_cost(rig, offsets, workspace, data, state):
    """f of the states in rows `state`, one lane each."""
    place_markers(rig, offsets, workspace, state)
    total = spread(workspace, 0.0)
    for i in range(len(rig.triangles)):
        residual = sub3(
            load3(workspace, offsets.marker + 3 * i), load3(workspace, offsets.observed + 3 * i)
        )
        squared = dot3(residual, residual)
        total = total + load(workspace, offsets.weight + i) * squared / (
            1.0 + squared * data.inverse_squared_scales[i]
        )
    return 0.5 * data.weight * total + prior_cost(data, workspace, state)


@jit_inline
def prior_cost(data, workspace, state):
    """1/2 (z - mean)^T precision (z - mean)."""
    total = spread(workspace, 0.0)
    for r in range(6, len(data.mean), 3):
        total = total + dot3(
            apart3(data, workspace, state, r), prior_gradient3(data, workspace, state, r)
        )
    return 0.5 * total


@jit_inline
def apart3(data, workspace, state, r):
    """Entries r, r + 1, r + 2 of z - mean."""
    x, y, z = load3(workspace, state + r)
    return x - data.mean[r], y - data.mean[r + 1], z - data.mean[r + 2]


@jit_inline
def prior_gradient3(data, workspace, state, r):
    """Entries r, r + 1, r + 2 of precision (z - mean); trans and root have none."""
    total = spread3(workspace, 0.0, 0.0, 0.0)
    precision = data.precision
    for c in range(6, len(data.mean)):
        off = load(workspace, state + c) - data.mean[c]
        total = add3(total, along3(off, precision[r, c], precision[r + 1, c], precision[r + 2, c]))
    return total


@jit_inline
def linearize(rig, slots, offsets, workspace, data):
    """f of the states in rows offsets.state, with gradient and matrix (blocks of its lower
    triangle) in their rows.
    """
    place_markers(rig, offsets, workspace, offsets.state)
    write_shape_jacobian(rig, offsets, workspace)
    write_hinge_turns(rig, offsets, workspace)
    clear(workspace, offsets.gradient, offsets.gradient + 3 * offsets.blocks)
    for r in range(offsets.blocks):
        clear(workspace, offsets.matrix + block_row(r, 0), offsets.matrix + block_row(r, 0) + 9)
    cost = spread(workspace, 0.0)
    for r in range(6, len(data.mean), 3):
        gradient = prior_gradient3(data, workspace, offsets.state, r)
        store3(workspace, offsets.gradient + r, gradient)
        cost = cost + 0.5 * dot3(apart3(data, workspace, offsets.state, r), gradient)
    for i in range(len(rig.triangles)):
        cost = cost + add_marker(rig, slots, offsets, workspace, data, i)
    add_pairs(slots, offsets, workspace, data)
    return cost


@jit_inline
def add_marker(rig, slots, offsets, workspace, data, i):
    """Add marker i to the gradient and to the matrix' first column; keep its weighted columns; its
    cost.
    """
    residual = sub3(
        load3(workspace, offsets.marker + 3 * i), load3(workspace, offsets.observed + 3 * i)
    )
    squared = dot3(residual, residual)
    share = 1.0 / (1.0 + squared * data.inverse_squared_scales[i])
    given = data.weight * load(workspace, offsets.weight + i)
    weight = given * share * share
    half = root(weight)
    write_columns(rig, slots, offsets, workspace, i, half)
    pull = scale3(half, residual)
    add_row3(workspace, offsets.gradient, scale3(weight, residual))
    for k in range(3):
        row = offsets.matrix + 4 * k
        store(workspace, row, load(workspace, row) + weight)
    for s in range(slots.start[i], slots.start[i + 1]):
        block = slots.block[s]
        m = load9(workspace, offsets.columns + 9 * s)
        add_row3(workspace, offsets.gradient + 3 * block, turn_back3(m, pull))
        row = offsets.matrix + block_row(block, 0)
        add_row3(workspace, row, scale3(half, (m[0], m[3], m[6])))
        add_row3(workspace, row + 3, scale3(half, (m[1], m[4], m[7])))
        add_row3(workspace, row + 6, scale3(half, (m[2], m[5], m[8])))
    return 0.5 * given * share * squared


@jit_inline
def add_pairs(slots, offsets, workspace, data):
    """Blocks (r, c), 1 <= c <= r, of the matrix: precision plus the columns' products."""
    pair = 0
    for r in range(1, offsets.blocks):
        for c in range(1, r + 1):
            x = spread3(workspace, 0.0, 0.0, 0.0)
            y = spread3(workspace, 0.0, 0.0, 0.0)
            z = spread3(workspace, 0.0, 0.0, 0.0)
            for k in range(slots.pair_start[pair], slots.pair_start[pair + 1]):
                a = load9(workspace, offsets.columns + 9 * slots.pair_left[k])
                b = load9(workspace, offsets.columns + 9 * slots.pair_right[k])
                x = plus_turned_back3(x, b, (a[0], a[3], a[6]))
                y = plus_turned_back3(y, b, (a[1], a[4], a[7]))
                z = plus_turned_back3(z, b, (a[2], a[5], a[8]))
            pair += 1
            x = plus_numbers3(x, data.precision, 3 * r, 3 * c)
            y = plus_numbers3(y, data.precision, 3 * r + 1, 3 * c)
            z = plus_numbers3(z, data.precision, 3 * r + 2, 3 * c)
            store9(
                workspace,
                offsets.matrix + block_row(r, c),
                (x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]),
            )


@jit_inline
def plus_numbers3(v, table, r, c):
    """v plus three entries of a table of numbers, in every lane."""
    return v[0] + table[r, c], v[1] + table[r, c + 1], v[2] + table[r, c + 2]
