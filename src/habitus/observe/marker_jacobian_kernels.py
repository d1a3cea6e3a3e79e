"""How predicted markers change with pose, trans and betas, for LANES frames at once (see
`habitus.observe.marker_kernels`).

Columns are kept for a marker's slots only (`habitus.observe.marker_slots`). A triangle that turns rigidly about joint j
needs no corners: dx = m x (x - p_j) for each column m of M_j.
"""

from habitus.kernels.jit import jit_inline
from habitus.kernels.simd import spread, store
from habitus.kernels.simd_linalg import (
    add3,
    cross3,
    dot3,
    load3,
    load9,
    load_column3,
    product9,
    scale3,
    spread3,
    store3,
    store9,
    sub3,
    turn3,
)
from habitus.observe.marker_kernels import marker_frame


@jit_inline
def carried_change(frame, da, de, df):
    """dx of a marker whose corner a and sides e, f change (`habitus.observe.marker_jacobian.corner_weights`)."""
    _, q, n, t, s, inverse, along, across = frame
    lift = inverse * dot3(n, de)
    x = scale3(inverse * dot3(s, de), cross3(n, q))
    y = scale3((dot3(n, df) - along * lift) / across, cross3(t, q))
    return sub3(add3(add3(da, x), y), scale3(lift, cross3(s, q)))


@jit_inline
def write_columns(rig, slots, offsets, workspace, i, weight):
    """Columns (3 x 3) of all slots of marker i, times `weight`."""
    frame, marker = marker_frame(rig, offsets, workspace, i), load3(workspace, offsets.marker + 3 * i)
    joints = len(rig.parents)
    for s in range(slots.start[i], slots.start[i + 1]):
        block = slots.block[s]
        if block > joints:
            x, y, z = beta_columns(rig, offsets, workspace, i, frame, 3 * (block - 1 - joints))
        else:
            x, y, z = turn_columns(slots, offsets, workspace, s, frame, marker)
            if slots.bent[s] == 1:
                dx, dy, dz = pose_feature_columns(rig, slots, offsets, workspace, i, s, frame)
                x, y, z = add3(x, dx), add3(y, dy), add3(z, dz)
        x, y, z = scale3(weight, x), scale3(weight, y), scale3(weight, z)
        store9(workspace, offsets.columns + 9 * s, (x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]))


@jit_inline
def turn_columns(slots, offsets, workspace, s, frame, marker):
    """Columns of a joint's three rotations by the turning of what hangs on it."""
    joint = slots.block[s] - 1
    axes, place = load9(workspace, offsets.axes + 9 * joint), load3(workspace, offsets.place + 3 * joint)
    p, q, r = (axes[0], axes[3], axes[6]), (axes[1], axes[4], axes[7]), (axes[2], axes[5], axes[8])
    if slots.rigid[s] == 1:
        arm = sub3(marker, place)
        return cross3(p, arm), cross3(q, arm), cross3(r, arm)
    a = corner_arm(slots, offsets, workspace, 3 * s, place)
    e = sub3(corner_arm(slots, offsets, workspace, 3 * s + 1, place), a)
    f = sub3(corner_arm(slots, offsets, workspace, 3 * s + 2, place), a)
    return turned_change(frame, p, a, e, f), turned_change(frame, q, a, e, f), turned_change(frame, r, a, e, f)


@jit_inline
def pose_feature_columns(rig, slots, offsets, workspace, i, s, frame):
    """What the pose blend shapes add: each corner moves by (sum_k w_ik G_k) P_ij dvec(R_j)."""
    row = offsets.feature_jacobian + 27 * (slots.block[s] - 1)
    ax, ay, az = corner_feature_columns(rig, offsets, workspace, rig.triangles[i, 0], slots.posedir[3 * s], row)
    bx, by, bz = corner_feature_columns(rig, offsets, workspace, rig.triangles[i, 1], slots.posedir[3 * s + 1], row)
    cx, cy, cz = corner_feature_columns(rig, offsets, workspace, rig.triangles[i, 2], slots.posedir[3 * s + 2], row)
    return bent_change(frame, ax, bx, cx), bent_change(frame, ay, by, cy), bent_change(frame, az, bz, cz)


@jit_inline
def bent_change(frame, da, db, dc):
    """dx where the corners change so."""
    return carried_change(frame, da, sub3(db, da), sub3(dc, da))


@jit_inline
def corner_feature_columns(rig, offsets, workspace, u, d, row):
    """Three columns of corner u's change by pose blend shape d (none if -1); `row` holds its features' Jacobian."""
    x, y, z = spread3(0.0, 0.0, 0.0), spread3(0.0, 0.0, 0.0), spread3(0.0, 0.0, 0.0)
    if d >= 0:
        for e in range(9):
            change = load3(workspace, row + 3 * e)
            x = add3(x, scale3(rig.posedirs[d, 0, e], change))
            y = add3(y, scale3(rig.posedirs[d, 1, e], change))
            z = add3(z, scale3(rig.posedirs[d, 2, e], change))
        m = product9(load9(workspace, offsets.blend + 9 * u), (x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]))
        x, y, z = (m[0], m[3], m[6]), (m[1], m[4], m[7]), (m[2], m[5], m[8])
    return x, y, z


@jit_inline
def write_pose_feature_jacobian(rig, offsets, workspace):
    """How vec(R_j) (rows first) changes with each joint's rotation: l x R for the columns l of the left Jacobian."""
    for j in range(1, len(rig.parents) if len(rig.posedir_joint) > 0 else 0):
        for m in range(3):
            axis = load_column3(workspace, offsets.left + 9 * j, m)
            for c in range(3):
                change = cross3(axis, load_column3(workspace, offsets.local + 9 * j, c))
                row = offsets.feature_jacobian + 27 * j + 3 * c + m
                store(workspace, row, change[0])
                store(workspace, row + 9, change[1])
                store(workspace, row + 18, change[2])


@jit_inline
def write_blends(rig, offsets, workspace):
    """sum_k w_ik G_k of every corner."""
    for u in range(len(rig.rest_corners)):
        x, y, z = spread3(0.0, 0.0, 0.0), spread3(0.0, 0.0, 0.0), spread3(0.0, 0.0, 0.0)
        for k in range(rig.influence_start[u], rig.influence_start[u + 1]):
            m, w = load9(workspace, offsets.world + 9 * rig.influence_joint[k]), rig.influence_weight[k]
            x = add3(x, scale3(w, (m[0], m[1], m[2])))
            y = add3(y, scale3(w, (m[3], m[4], m[5])))
            z = add3(z, scale3(w, (m[6], m[7], m[8])))
        store9(workspace, offsets.blend + 9 * u, (x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]))


@jit_inline
def corner_arm(slots, offsets, workspace, part, place):
    """sum over a corner's influences below the joint of u_ik - w_ik p_j."""
    total = scale3(spread(-slots.part_weight[part]), place)
    for k in range(slots.part_start[part], slots.part_start[part + 1]):
        total = add3(total, load3(workspace, offsets.carried + 3 * slots.part_influence[k]))
    return total


@jit_inline
def turned_change(frame, axis, a, e, f):
    """dx where the corner and the sides turn about `axis` with these arms."""
    return carried_change(frame, cross3(axis, a), cross3(axis, e), cross3(axis, f))


@jit_inline
def beta_columns(rig, offsets, workspace, i, frame, first):
    """Columns of three betas."""
    x = beta_column(rig, offsets, workspace, i, frame, first)
    y = beta_column(rig, offsets, workspace, i, frame, first + 1)
    return x, y, beta_column(rig, offsets, workspace, i, frame, first + 2)


@jit_inline
def beta_column(rig, offsets, workspace, i, frame, b):
    """dx with beta b, from the derivatives of the three corners."""
    count = rig.corner_shapedirs.shape[2]
    a = load3(workspace, offsets.corner_by_shape + 3 * (rig.triangles[i, 0] * count + b))
    e = sub3(load3(workspace, offsets.corner_by_shape + 3 * (rig.triangles[i, 1] * count + b)), a)
    f = sub3(load3(workspace, offsets.corner_by_shape + 3 * (rig.triangles[i, 2] * count + b)), a)
    return carried_change(frame, a, e, f)


@jit_inline
def write_shape_jacobian(rig, offsets, workspace):
    """How joints' offsets and then corners change with each beta."""
    dirs, count = rig.corner_shapedirs, rig.corner_shapedirs.shape[2]
    if count + len(rig.posedir_joint) > 0:
        write_blends(rig, offsets, workspace)
    for b in range(count):
        write_joint_slopes(rig, offsets, workspace, b)
    for u in range(len(rig.rest_corners) if count > 0 else 0):
        blend = load9(workspace, offsets.blend + 9 * u)
        for b in range(count):
            total = turn3(blend, (dirs[u, 0, b], dirs[u, 1, b], dirs[u, 2, b]))
            for k in range(rig.influence_start[u], rig.influence_start[u + 1]):
                by_shape = load3(workspace, offsets.joint_by_shape + 3 * (rig.influence_joint[k] * count + b))
                total = add3(total, scale3(spread(rig.influence_weight[k]), by_shape))
            store3(workspace, offsets.corner_by_shape + 3 * (u * count + b), total)


@jit_inline
def write_joint_slopes(rig, offsets, workspace, b):
    """dp_j - G_j dJ_j of every joint for beta b; dp_j = dp_parent + G_parent d(J_j - J_parent)."""
    dirs, count = rig.joint_shapedirs, rig.joint_shapedirs.shape[2]
    for j in range(len(rig.parents)):
        parent = rig.parents[j]
        change = spread3(dirs[j, 0, b], dirs[j, 1, b], dirs[j, 2, b])
        moved = change
        if parent >= 0:
            # with o = p - G J: dp_j = do_parent + G_parent dJ_j
            above = load3(workspace, offsets.joint_by_shape + 3 * (parent * count + b))
            moved = add3(above, turn3(load9(workspace, offsets.world + 9 * parent), change))
        moved = sub3(moved, turn3(load9(workspace, offsets.world + 9 * j), change))
        store3(workspace, offsets.joint_by_shape + 3 * (j * count + b), moved)
