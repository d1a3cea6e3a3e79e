"""Predicted markers for LANES frames at once: compiled; `habitus.observe.markers` states them.

Every frame has a SIMD lane, and everything lies in one workspace (n, LANES) laid out by `Offsets`.
"""

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.kernels.simd import load, root, spread, store, where_less
from habitus.kernels.simd_linalg import (
    add3,
    along3,
    cross3,
    dot3,
    load3,
    load9,
    product9,
    rotation_and_jacobian9,
    scale3,
    spread3,
    store3,
    store9,
    sub3,
    turn3,
    unit3,
)


@jit_noalloc
def predict_frames(rig, offsets, workspace, states, markers):
    """Markers (T, M, 3) of states (T, N)."""
    lanes = workspace.shape[1]
    for first in range(0, len(states), lanes):
        for k in range(lanes):
            t = min(first + k, len(states) - 1)
            for n in range(states.shape[1]):
                workspace[offsets.state + n, k] = states[t, n]
        place_markers(rig, offsets, workspace, offsets.state)
        for k in range(min(lanes, len(states) - first)):
            for i in range(len(rig.triangles)):
                for c in range(3):
                    markers[first + k, i, c] = workspace[offsets.marker + 3 * i + c, k]


@jit_inline
def place_markers(rig, offsets, workspace, state):
    """Joints, corners and markers of the states in rows `state`."""
    shape_joints(rig, offsets, workspace, state)
    move_joints(rig, offsets, workspace, state)
    weigh_hinges(rig, offsets, workspace)
    shape_corners(rig, offsets, workspace, state)
    move_corners(rig, offsets, workspace)
    for i in range(len(rig.triangles)):
        a, q, _, _, _, _, _, _ = marker_frame(rig, offsets, workspace, i)
        store3(workspace, offsets.marker + 3 * i, add3(a, q))


@jit_inline
def shape_joints(rig, offsets, workspace, state):
    """Rest places of the joints, moved by the betas of each lane."""
    betas = state + 3 + 3 * len(rig.parents)
    dirs = rig.joint_shapedirs
    for j in range(len(rig.parents)):
        rest = spread3(
            workspace, rig.rest_joints[j, 0], rig.rest_joints[j, 1], rig.rest_joints[j, 2]
        )
        for b in range(dirs.shape[2]):
            rest = add3(
                rest,
                along3(load(workspace, betas + b), dirs[j, 0, b], dirs[j, 1, b], dirs[j, 2, b]),
            )
        store3(workspace, offsets.rest_joint + 3 * j, rest)


@jit_inline
def move_joints(rig, offsets, workspace, state):
    """World rotations G, places p, offsets p - G J and turning axes M of the joints; local R and
    its left Jacobian.
    """
    for j in range(len(rig.parents)):
        rotation, left = rotation_and_jacobian9(load3(workspace, state + 3 + 3 * j))
        store9(workspace, offsets.local + 9 * j, rotation)
        store9(workspace, offsets.left + 9 * j, left)
        rest = load3(workspace, offsets.rest_joint + 3 * j)
        parent = rig.parents[j]
        if parent < 0:
            place = add3(rest, load3(workspace, state))
        else:
            above = load9(workspace, offsets.world + 9 * parent)
            rotation = product9(above, rotation)
            left = product9(above, left)
            bone = sub3(rest, load3(workspace, offsets.rest_joint + 3 * parent))
            place = add3(load3(workspace, offsets.place + 3 * parent), turn3(above, bone))
        store9(workspace, offsets.world + 9 * j, rotation)
        store9(workspace, offsets.axes + 9 * j, left)
        store3(workspace, offsets.place + 3 * j, place)
        store3(workspace, offsets.offset + 3 * j, sub3(place, turn3(rotation, rest)))


@jit_inline
def weigh_hinges(rig, offsets, workspace):
    """Weight w = clip(x, 0, 1)^2 of each hinge channel, and dw / dx."""
    for h in range(len(rig.hinge_joint)):
        local = offsets.local + 9 * rig.hinge_joint[h]
        x = spread(workspace, -rig.hinge_bias[h])
        for e in range(9):
            x = x + rig.hinge_rows[h, e] * (
                load(workspace, local + e) - (1.0 if e % 4 == 0 else 0.0)
            )
        x = where_less(x, 0.0, 0.0, x)
        slope = where_less(x, 1.0, 2.0 * x, 0.0)
        x = where_less(x, 1.0, x, 1.0)
        store(workspace, offsets.fold + 5 * h, x * x)
        store(workspace, offsets.fold + 5 * h + 1, slope)


@jit_inline
def shape_corners(rig, offsets, workspace, state):
    """Rest places of the corners with betas and pose blend shapes added."""
    betas = state + 3 + 3 * len(rig.parents)
    dirs = rig.corner_shapedirs
    posedirs = rig.posedirs
    for u in range(len(rig.rest_corners)):
        rest = spread3(
            workspace, rig.rest_corners[u, 0], rig.rest_corners[u, 1], rig.rest_corners[u, 2]
        )
        for b in range(dirs.shape[2]):
            rest = add3(
                rest,
                along3(load(workspace, betas + b), dirs[u, 0, b], dirs[u, 1, b], dirs[u, 2, b]),
            )
        for d in range(rig.posedir_start[u], rig.posedir_start[u + 1]):
            local = offsets.local + 9 * rig.posedir_joint[d]
            for e in range(9):
                change = load(workspace, local + e) - (1.0 if e % 4 == 0 else 0.0)
                rest = add3(
                    rest, along3(change, posedirs[d, 0, e], posedirs[d, 1, e], posedirs[d, 2, e])
                )
            for k in range(rig.fold_start[d], rig.fold_start[d + 1]):
                weight = load(workspace, offsets.fold + 5 * rig.fold_channel[k])
                fold = rig.folds[k]
                rest = add3(rest, along3(weight, fold[0], fold[1], fold[2]))
        for b in range(rig.fold_shapes.shape[2]):
            change = fold_change(rig, offsets, workspace, u, b)
            rest = add3(rest, scale3(load(workspace, betas + b), change))
        store3(workspace, offsets.rest + 3 * u, rest)


@jit_inline
def fold_change(rig, offsets, workspace, u, b):
    """How the hinges move a corner per unit of beta b."""
    total = spread3(workspace, 0.0, 0.0, 0.0)
    for d in range(rig.posedir_start[u], rig.posedir_start[u + 1]):
        for k in range(rig.fold_start[d], rig.fold_start[d + 1]):
            weight = load(workspace, offsets.fold + 5 * rig.fold_channel[k])
            fold = rig.fold_shapes[k]
            total = add3(total, along3(weight, fold[0, b], fold[1, b], fold[2, b]))
    return total


@jit_inline
def move_corners(rig, offsets, workspace):
    """Corners in the world, and the share u_ik of each influence in them."""
    for u in range(len(rig.rest_corners)):
        rest = load3(workspace, offsets.rest + 3 * u)
        total = spread3(workspace, 0.0, 0.0, 0.0)
        for k in range(rig.influence_start[u], rig.influence_start[u + 1]):
            j = rig.influence_joint[k]
            moved = add3(
                turn3(load9(workspace, offsets.world + 9 * j), rest),
                load3(workspace, offsets.offset + 3 * j),
            )
            moved = scale3(spread(workspace, rig.influence_weight[k]), moved)
            store3(workspace, offsets.carried + 3 * k, moved)
            total = add3(total, moved)
        store3(workspace, offsets.corner + 3 * u, total)


@jit_inline
def marker_frame(rig, offsets, workspace, i):
    """Corner a, q (the marker stands at a + q), the basis n, t, s, then 1 / |e|, f . t and f .
    s.
    """
    a = load3(workspace, offsets.corner + 3 * rig.triangles[i, 0])
    e = sub3(load3(workspace, offsets.corner + 3 * rig.triangles[i, 1]), a)
    f = sub3(load3(workspace, offsets.corner + 3 * rig.triangles[i, 2]), a)
    inverse = 1.0 / root(dot3(e, e))
    t = scale3(inverse, e)
    n = unit3(cross3(e, f))
    s = cross3(n, t)
    up = rig.coefficients[i, 0]
    along = rig.coefficients[i, 1]
    across = rig.coefficients[i, 2]
    q = (
        up * n[0] + along * t[0] + across * s[0],
        up * n[1] + along * t[1] + across * s[1],
        up * n[2] + along * t[2] + across * s[2],
    )
    return a, q, n, t, s, inverse, dot3(f, t), dot3(f, s)
