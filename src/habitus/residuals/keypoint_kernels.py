"""Normal equations of frames that cameras see as keypoints, for LANES frames at once: the compiled
form of `habitus.residuals.keypoint_terms.Keypoints` with a Gaussian over the poses.

    f = 1/2 sum_ck w_ck rho(|r_ck|^2) + 1/2 sum_k v_k rho_3(|q_k - t_k|^2)
        + 1/2 (z - mean)^T precision (z - mean)

r_ck: pixels of keypoint k in camera c, expected less observed; w, v: information (1 / px^2, 1 /
m^2), 0 where nothing was seen. rho(s) = s / (1 + w s / h^2): Geman-McClure's of h standard
deviations, so that a detection weighs at most h^2.

All cameras of a keypoint become one 3 x 3 information A and one pull on its point. About the body's
root, at r from it, they are the 6 x 6 information of a rigid body,

    S = J^T A J,  J = [-[r]x  I],

which add up along the skeleton (Featherstone, "Rigid Body Dynamics Algorithms", ch. 6): the block
of joints j and i above it is U_j^T S_j U_i, S_j of all that j moves, and U_j the twists of j's
rotation vector.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.kernels.jit import jit, jit_inline
from habitus.kernels.simd import load, spread, store, where_less
from habitus.kernels.simd_linalg import (
    add3,
    add_row3,
    block_row,
    clear,
    cross3,
    dot3,
    load3,
    load9,
    spread3,
    store3,
    store9,
    sub3,
    turn3,
    turn_back3,
)
from habitus.observe.marker_kernels import move_joints
from habitus.residuals.marker_kernels import prior_cost, prior_gradient3

NEAR = 0.1
INFORMATION = 33
"""Rows of one rigid body: turns (9), turns with shifts (9), shifts (9), pulls of both (6)."""


class KeypointData(NamedTuple):
    """A person's skeleton, the cameras, what they saw in T frames, and the prior."""

    parents: Int[np.ndarray, " J"]
    bone: Int[np.ndarray, " K"]
    joints: Float[np.ndarray, "J 3"]
    places: Float[np.ndarray, "K 3"]
    focal: Float[np.ndarray, "C 2"]
    centre: Float[np.ndarray, "C 2"]
    rotation: Float[np.ndarray, "C 3 3"]
    translation: Float[np.ndarray, "C 3"]
    pixels: Float[np.ndarray, "T C K 2"]
    weights: Float[np.ndarray, "T C K"]
    points: Float[np.ndarray, "T K 3"]
    point_weights: Float[np.ndarray, "T K"]
    reach: float
    """h."""
    mean: Float[np.ndarray, " N"]
    precision: Float[np.ndarray, "N N"]


class KeypointOffsets(NamedTuple):
    """Where things lie in the workspace (end, LANES) of one group of frames: the first row of
    each.
    """

    state: int
    trial: int
    gradient: int
    step: int
    pull: int
    stiffness: int
    rest_joint: int
    local: int
    left: int
    world: int
    axes: int
    place: int
    offset: int
    body: int
    """`INFORMATION` of each joint with all that it moves."""
    seen: int
    """Pixel and weight of each keypoint in each camera."""
    point: int
    """Place and weight of each keypoint that is known otherwise."""
    matrix: int
    blocks: int
    end: int

    @staticmethod
    def of(joints: int, keypoints: int, cameras: int) -> "KeypointOffsets":
        """For so many of each."""
        blocks = 1 + joints
        size = 3 * blocks
        rows = [size] * 6 + [3 * joints] + [9 * joints] * 4 + [3 * joints] * 2
        rows += [INFORMATION * joints, 3 * cameras * keypoints, 4 * keypoints]
        rows += [9 * blocks * (blocks + 1) // 2]
        first = np.concatenate([[0], np.cumsum(rows)]).tolist()
        return KeypointOffsets._make([*first[:-1], blocks, first[-1]])


@jit_inline
def gather_keypoints(data, offsets, workspace, frames, states, group):
    """Bring states and observations of a group to its lanes."""
    keypoints = len(data.bone)
    cameras = len(data.focal)
    for k in range(workspace.shape[1]):
        t = frames[group[k]]
        for n in range(states.shape[1]):
            workspace[offsets.state + n, k] = states[group[k], n]
        for c in range(cameras):
            for i in range(keypoints):
                row = offsets.seen + 3 * (c * keypoints + i)
                workspace[row, k] = data.pixels[t, c, i, 0]
                workspace[row + 1, k] = data.pixels[t, c, i, 1]
                workspace[row + 2, k] = data.weights[t, c, i]
        for i in range(keypoints):
            for m in range(3):
                workspace[offsets.point + 4 * i + m, k] = data.points[t, i, m]
            workspace[offsets.point + 4 * i + 3, k] = data.point_weights[t, i]
    for j in range(len(data.parents)):
        rest = spread3(workspace, data.joints[j, 0], data.joints[j, 1], data.joints[j, 2])
        store3(workspace, offsets.rest_joint + 3 * j, rest)


@jit
def keypoint_costs(data, offsets, workspace, frames, states, out):
    """f of frames in their states (F, N), into out (F,)."""
    lanes = workspace.shape[1]
    group = np.empty(lanes, dtype=np.int64)
    for first in range(0, len(frames), lanes):
        for k in range(lanes):
            group[k] = min(first + k, len(frames) - 1)
        gather_keypoints(data, offsets, workspace, frames, states, group)
        cost = keypoint_cost(data, offsets, workspace, offsets.state)
        store(workspace, offsets.step, cost)
        for k in range(lanes):
            out[group[k]] = workspace[offsets.step, k]


@jit
def normal_equations(data, offsets, workspace, frames, states, out, gradients, matrices):
    """f (F,), gradients (F, N) and matrices (F, N, N) of frames in their states."""
    lanes = workspace.shape[1]
    group = np.empty(lanes, dtype=np.int64)
    for first in range(0, len(frames), lanes):
        for k in range(lanes):
            group[k] = min(first + k, len(frames) - 1)
        gather_keypoints(data, offsets, workspace, frames, states, group)
        cost = linearize_keypoints(data, offsets, workspace)
        store(workspace, offsets.step, cost)
        for k in range(lanes):
            out[group[k]] = workspace[offsets.step, k]
            for r in range(states.shape[1]):
                gradients[group[k], r] = workspace[offsets.gradient + r, k]
                for c in range(r + 1):
                    row = offsets.matrix + block_row(r // 3, c // 3) + 3 * (r % 3) + c % 3
                    matrices[group[k], r, c] = workspace[row, k]
                    matrices[group[k], c, r] = workspace[row, k]


@jit_inline
def keypoint_cost(data, offsets, workspace, state):
    """f of the states in rows `state`, one lane each."""
    move_joints(data, offsets, workspace, state)
    cost = prior_cost(data, workspace, state)
    for k in range(len(data.bone)):
        cost = cost + observe(data, offsets, workspace, k)[0]
    return cost


@jit_inline
def observe(data, offsets, workspace, k):
    """Of keypoint k its cost, place, pull, and the lower triangle of its information."""
    b = data.bone[k]
    own = spread3(workspace, data.places[k, 0], data.places[k, 1], data.places[k, 2])
    world = load9(workspace, offsets.world + 9 * b)
    q = add3(load3(workspace, offsets.place + 3 * b), turn3(world, own))
    keypoints = len(data.bone)
    least = 1.0 / (data.reach * data.reach)
    behind = 0.5 * data.reach * data.reach
    known = load(workspace, offsets.point + 4 * k + 3)
    off = sub3(q, load3(workspace, offsets.point + 4 * k))
    squared = dot3(off, off)
    share = 1.0 / (1.0 + known * squared * least)
    cost = 0.5 * known * share * squared
    weight = known * share * share
    pull = weight * off[0], weight * off[1], weight * off[2]
    none = spread(workspace, 0.0)
    xx, xy, yy, xz, yz, zz = weight, none, weight, none, none, weight
    for c in range(len(data.focal)):
        row = offsets.seen + 3 * (c * keypoints + k)
        w = load(workspace, row + 2)
        turn = data.rotation[c]
        x = turn[0, 0] * q[0] + turn[0, 1] * q[1] + turn[0, 2] * q[2] + data.translation[c, 0]
        y = turn[1, 0] * q[0] + turn[1, 1] * q[1] + turn[1, 2] * q[2] + data.translation[c, 1]
        z = turn[2, 0] * q[0] + turn[2, 1] * q[1] + turn[2, 2] * q[2] + data.translation[c, 2]
        hidden = where_less(z, NEAR, w, 0.0)
        cost = cost + where_less(0.0, hidden, behind, 0.0)
        w = where_less(z, NEAR, 0.0, w)
        inverse = 1.0 / where_less(z, NEAR, NEAR, z)
        fx, fy = data.focal[c, 0] * inverse, data.focal[c, 1] * inverse
        px, py = x * inverse, y * inverse
        u = data.focal[c, 0] * px + data.centre[c, 0] - load(workspace, row)
        v = data.focal[c, 1] * py + data.centre[c, 1] - load(workspace, row + 1)
        squared = u * u + v * v
        share = 1.0 / (1.0 + w * squared * least)
        cost = cost + 0.5 * w * share * squared
        weight = w * share * share
        ax, ay, az = (
            fx * (turn[0, 0] - px * turn[2, 0]),
            fx * (turn[0, 1] - px * turn[2, 1]),
            fx * (turn[0, 2] - px * turn[2, 2]),
        )
        bx, by, bz = (
            fy * (turn[1, 0] - py * turn[2, 0]),
            fy * (turn[1, 1] - py * turn[2, 1]),
            fy * (turn[1, 2] - py * turn[2, 2]),
        )
        pull = (
            pull[0] + weight * (ax * u + bx * v),
            pull[1] + weight * (ay * u + by * v),
            pull[2] + weight * (az * u + bz * v),
        )
        xx = xx + weight * (ax * ax + bx * bx)
        xy = xy + weight * (ax * ay + bx * by)
        yy = yy + weight * (ay * ay + by * by)
        xz = xz + weight * (ax * az + bx * bz)
        yz = yz + weight * (ay * az + by * bz)
        zz = zz + weight * (az * az + bz * bz)
    return cost, q, pull, (xx, xy, xz, xy, yy, yz, xz, yz, zz)


@jit_inline
def linearize_keypoints(data, offsets, workspace):
    """f of the states in rows offsets.state, with gradient and matrix (blocks of its lower
    triangle) in their rows.
    """
    move_joints(data, offsets, workspace, offsets.state)
    joints = len(data.parents)
    clear(workspace, offsets.body, offsets.body + INFORMATION * joints)
    cost = prior_cost(data, workspace, offsets.state)
    for k in range(len(data.bone)):
        own, q, pull, information = observe(data, offsets, workspace, k)
        cost = cost + own
        r = sub3(q, load3(workspace, offsets.place))
        add_body(workspace, offsets.body + INFORMATION * data.bone[k], r, pull, information)
    for j in range(joints - 1, 0, -1):
        row = offsets.body + INFORMATION * j
        above = offsets.body + INFORMATION * data.parents[j]
        for n in range(INFORMATION):
            store(workspace, above + n, load(workspace, above + n) + load(workspace, row + n))
    write_prior(data, offsets, workspace)
    store9(workspace, offsets.matrix, load9(workspace, offsets.body + 18))
    add_row3(workspace, offsets.gradient, load3(workspace, offsets.body + 30))
    for j in range(joints):
        add_joint(data, offsets, workspace, j)
    return cost


@jit_inline
def add_body(workspace, row, r, pull, a):
    """Add a point at r from the root, its information ``a`` and pull, to a rigid body."""
    # B = [r]x A, column by column; C = B [r]x^T, row by row
    x = cross3(r, (a[0], a[3], a[6]))
    y = cross3(r, (a[1], a[4], a[7]))
    z = cross3(r, (a[2], a[5], a[8]))
    b = (x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2])
    for n in range(3):
        add_row3(workspace, row + 3 * n, cross3(r, (x[n], y[n], z[n])))
        add_row3(workspace, row + 9 + 3 * n, (b[3 * n], b[3 * n + 1], b[3 * n + 2]))
        add_row3(workspace, row + 18 + 3 * n, (a[3 * n], a[3 * n + 1], a[3 * n + 2]))
    add_row3(workspace, row + 27, cross3(r, pull))
    add_row3(workspace, row + 30, pull)


@jit_inline
def write_prior(data, offsets, workspace):
    """The Gaussian's gradient and matrix."""
    clear(workspace, offsets.gradient, offsets.gradient + 6)
    for r in range(6, len(data.mean), 3):
        gradient = prior_gradient3(data, workspace, offsets.state, r)
        store3(workspace, offsets.gradient + r, gradient)
    for r in range(offsets.blocks):
        for c in range(r + 1):
            row = offsets.matrix + block_row(r, c)
            for i in range(3):
                for m in range(3):
                    store(
                        workspace,
                        row + 3 * i + m,
                        spread(workspace, data.precision[3 * r + i, 3 * c + m]),
                    )


@jit_inline
def twist(offsets, workspace, j, c):
    """How entry c of joint j's rotation vector turns and shifts what it moves, at the root."""
    row = offsets.axes + 9 * j + c
    axis = load(workspace, row), load(workspace, row + 3), load(workspace, row + 6)
    away = sub3(load3(workspace, offsets.place + 3 * j), load3(workspace, offsets.place))
    return axis, cross3(away, axis)


@jit_inline
def add_joint(data, offsets, workspace, j):
    """Joint j's row of blocks: with the place, with the joints above it, and with itself."""
    row = offsets.body + INFORMATION * j
    turns = load9(workspace, row)
    mixed = load9(workspace, row + 9)
    shifts = load9(workspace, row + 18)
    pull_turn, pull_shift = load3(workspace, row + 27), load3(workspace, row + 30)
    for c in range(3):
        w, v = twist(offsets, workspace, j, c)
        gradient = offsets.gradient + 3 + 3 * j + c
        own = dot3(w, pull_turn) + dot3(v, pull_shift)
        store(workspace, gradient, load(workspace, gradient) + own)
        force_turn = add3(turn3(turns, w), turn3(mixed, v))
        force_shift = add3(turn_back3(mixed, w), turn3(shifts, v))
        add_row3(workspace, offsets.matrix + block_row(1 + j, 0) + 3 * c, force_shift)
        i = j
        while i >= 0:
            at = offsets.matrix + block_row(1 + j, 1 + i) + 3 * c
            for m in range(3):
                other_w, other_v = twist(offsets, workspace, i, m)
                value = dot3(force_turn, other_w) + dot3(force_shift, other_v)
                store(workspace, at + m, load(workspace, at + m) + value)
            i = data.parents[i]
