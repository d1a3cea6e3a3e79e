"""How predicted markers change with pose, trans and betas, for LANES frames at once (see
`habitus.observe.marker_kernels`).

Columns are kept for a marker's slots only (`habitus.observe.marker_rig`). A triangle that turns
rigidly about joint j needs no corners: dx = m x (x - p_j) for each column m of M_j.
"""

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.kernels.simd import load, spread
from habitus.kernels.simd_linalg import (
    add3,
    along3,
    cross3,
    dot3,
    load3,
    load9,
    scale3,
    spread3,
    store3,
    store9,
    sub3,
    turn3,
    turn_back3,
)
from habitus.observe.marker_kernels import fold_change, marker_frame, place_markers


@jit_noalloc
def marker_columns(rig, slots, offsets, workspace, states, corners, columns):
    """Corners (T, U, 3) of states (T, N), and how markers move with pose and betas, coefficients
    held, into ``columns`` (T, M, 3, N), of which only what is not zero is written; nor are those of
    trans, which are the identity.
    """
    lanes = workspace.shape[1]
    for first in range(0, len(states), lanes):
        for k in range(lanes):
            t = min(first + k, len(states) - 1)
            for n in range(states.shape[1]):
                workspace[offsets.state + n, k] = states[t, n]
        place_markers(rig, offsets, workspace, offsets.state)
        write_shape_jacobian(rig, offsets, workspace)
        write_hinge_turns(rig, offsets, workspace)
        for i in range(len(rig.triangles)):
            write_columns(rig, slots, offsets, workspace, i, spread(workspace, 1.0))
        for k in range(min(lanes, len(states) - first)):
            for u in range(len(rig.rest_corners)):
                for c in range(3):
                    corners[first + k, u, c] = workspace[offsets.corner + 3 * u + c, k]
            for i in range(len(rig.triangles)):
                for s in range(slots.start[i], slots.start[i + 1]):
                    n = 3 * slots.block[s]
                    for c in range(3):
                        for d in range(3):
                            value = workspace[offsets.columns + 9 * s + 3 * c + d, k]
                            columns[first + k, i, c, n + d] = value


@jit_inline
def marker_carriage(frame):
    """n, s, p, u, v: how a marker follows its corner a and sides e, f, dx = da + p (s . de) + u (n
    . df) - v (n . de) (`habitus.observe.markers.corner_weights`).
    """
    _, q, n, t, s, inverse, along, across = frame
    u = scale3(1.0 / across, cross3(t, q))
    v = scale3(inverse, add3(cross3(s, q), scale3(along, u)))
    return n, s, scale3(inverse, cross3(n, q)), u, v


@jit_inline
def carried(carriage, da, by_s, by_f, by_n):
    """dx of a marker for da and s . de, n . df, n . de."""
    _, _, p, u, v = carriage
    return (
        da[0] + p[0] * by_s + u[0] * by_f - v[0] * by_n,
        da[1] + p[1] * by_s + u[1] * by_f - v[1] * by_n,
        da[2] + p[2] * by_s + u[2] * by_f - v[2] * by_n,
    )


@jit_inline
def carried_change(carriage, da, de, df):
    """dx of a marker whose corner a and sides e, f change."""
    n, s, _, _, _ = carriage
    return carried(carriage, da, dot3(s, de), dot3(n, df), dot3(n, de))


@jit_inline
def write_columns(rig, slots, offsets, workspace, i, weight):
    """Columns (3 x 3) of all slots of marker i, times `weight`."""
    carriage = marker_carriage(marker_frame(rig, offsets, workspace, i))
    marker = load3(workspace, offsets.marker + 3 * i)
    blends = marker_blends(rig, offsets, workspace, i, carriage)
    joints = len(rig.parents)
    for s in range(slots.start[i], slots.start[i + 1]):
        block = slots.block[s]
        if block > joints:
            x, y, z = beta_columns(rig, offsets, workspace, i, carriage, 3 * (block - 1 - joints))
        else:
            x, y, z = turn_columns(slots, offsets, workspace, s, carriage, marker)
            if slots.bent[s] == 1:
                dx, dy, dz = pose_shape_columns(rig, slots, offsets, workspace, s, carriage, blends)
                x = add3(x, dx)
                y = add3(y, dy)
                z = add3(z, dz)
        x = scale3(weight, x)
        y = scale3(weight, y)
        z = scale3(weight, z)
        store9(
            workspace,
            offsets.columns + 9 * s,
            (x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]),
        )


@jit_inline
def turn_columns(slots, offsets, workspace, s, carriage, marker):
    """Columns of a joint's three rotations by the turning of what hangs on it."""
    joint = slots.block[s] - 1
    axes = load9(workspace, offsets.axes + 9 * joint)
    place = load3(workspace, offsets.place + 3 * joint)
    p = (axes[0], axes[3], axes[6])
    q = (axes[1], axes[4], axes[7])
    r = (axes[2], axes[5], axes[8])
    if slots.rigid[s] == 1:
        arm = sub3(marker, place)
        return cross3(p, arm), cross3(q, arm), cross3(r, arm)
    a = corner_arm(slots, offsets, workspace, 3 * s, place)
    e = sub3(corner_arm(slots, offsets, workspace, 3 * s + 1, place), a)
    f = sub3(corner_arm(slots, offsets, workspace, 3 * s + 2, place), a)
    n = carriage[0]
    arms = (a, cross3(e, carriage[1]), cross3(f, n), cross3(e, n))  # s . (m x e) = m . (e x s)
    return (
        turned_change(carriage, p, arms),
        turned_change(carriage, q, arms),
        turned_change(carriage, r, arms),
    )


@jit_inline
def turned_change(carriage, axis, arms):
    """dx where the corner and the sides turn about `axis`."""
    a, es, fn, en = arms
    return carried(carriage, cross3(axis, a), dot3(axis, es), dot3(axis, fn), dot3(axis, en))


@jit_inline
def marker_blends(rig, offsets, workspace, i, carriage):
    """How a marker follows its corners where these move at rest: of corner a all, of b along s and
    n, of c along n.
    """
    n, s, _, _, _ = carriage
    a = rig.triangles[i, 0]
    b = rig.triangles[i, 1]
    c = rig.triangles[i, 2]
    m = load9(workspace, offsets.blend + 9 * a)
    second = load9(workspace, offsets.blend + 9 * b)
    x = (m[0], m[3], m[6])
    y = (m[1], m[4], m[7])
    z = (m[2], m[5], m[8])
    first = (alone_change(carriage, x), alone_change(carriage, y), alone_change(carriage, z))
    third = turn_back3(load9(workspace, offsets.blend + 9 * c), n)
    return first, turn_back3(second, s), turn_back3(second, n), third


@jit_inline
def alone_change(carriage, da):
    """dx where corner a changes, and b and c do not."""
    n, s, _, _, _ = carriage
    across = dot3(n, da)
    return carried(carriage, da, -dot3(s, da), -across, -across)


@jit_inline
def pose_shape_columns(rig, slots, offsets, workspace, s, carriage, blends):
    """What the pose blend shapes add: each corner moves by (sum_k w_ik G_k) P_ij dvec(R_j)."""
    joint = slots.block[s] - 1
    turned = load9(workspace, offsets.local + 9 * joint)
    left = load9(workspace, offsets.left + 9 * joint)
    first, by_s, by_n, by_f = blends
    a = rest_slopes(rig, offsets, workspace, slots.posedir[3 * s], turned)
    b = rest_slopes(rig, offsets, workspace, slots.posedir[3 * s + 1], turned)
    c = rest_slopes(rig, offsets, workspace, slots.posedir[3 * s + 2], turned)
    bs = mixed3(by_s, b)
    bn = mixed3(by_n, b)
    cn = mixed3(by_f, c)
    x = carried(carriage, mixed3((a[0][0], a[1][0], a[2][0]), first), bs[0], cn[0], bn[0])
    y = carried(carriage, mixed3((a[0][1], a[1][1], a[2][1]), first), bs[1], cn[1], bn[1])
    z = carried(carriage, mixed3((a[0][2], a[1][2], a[2][2]), first), bs[2], cn[2], bn[2])
    turns = (x, y, z)
    return (
        mixed3((left[0], left[3], left[6]), turns),
        mixed3((left[1], left[4], left[7]), turns),
        mixed3((left[2], left[5], left[8]), turns),
    )


@jit_inline
def mixed3(shares, vectors):
    """The sum of three vectors, each times its share."""
    (a, b, c), (x, y, z) = shares, vectors
    return (
        a * x[0] + b * y[0] + c * z[0],
        a * x[1] + b * y[1] + c * z[1],
        a * x[2] + b * y[2] + c * z[2],
    )


@jit_inline
def rest_slopes(rig, offsets, workspace, d, turned):
    """How x, y and z of a corner at rest change by pose blend shape d (none if -1) and the joint's
    hinges as R_j is turned from the left: sum_c R_c x P_c over the columns c.
    """
    x = spread3(workspace, 0.0, 0.0, 0.0)
    y = spread3(workspace, 0.0, 0.0, 0.0)
    z = spread3(workspace, 0.0, 0.0, 0.0)
    betas = offsets.state + 3 + 3 * len(rig.parents)
    if d >= 0:
        x = slope(rig.posedirs[d, 0], turned)
        y = slope(rig.posedirs[d, 1], turned)
        z = slope(rig.posedirs[d, 2], turned)
        for k in range(rig.fold_start[d], rig.fold_start[d + 1]):
            h = rig.fold_channel[k]
            fold = spread3(workspace, rig.folds[k, 0], rig.folds[k, 1], rig.folds[k, 2])
            for b in range(rig.fold_shapes.shape[2]):
                change = rig.fold_shapes[k]
                beta = load(workspace, betas + b)
                fold = add3(fold, along3(beta, change[0, b], change[1, b], change[2, b]))
            turns = load3(workspace, offsets.fold + 5 * h + 2)
            x = add3(x, scale3(fold[0], turns))
            y = add3(y, scale3(fold[1], turns))
            z = add3(z, scale3(fold[2], turns))
    return x, y, z


@jit_inline
def slope(p, r):
    """The same of one coordinate, whose 3 x 3 numbers are p: sum_c r_c x p_c over their columns.

    Written out, as each small function that is called takes as long to compile as this.
    """
    return (
        (r[3] * p[6] - r[6] * p[3]) + (r[4] * p[7] - r[7] * p[4]) + (r[5] * p[8] - r[8] * p[5]),
        (r[6] * p[0] - r[0] * p[6]) + (r[7] * p[1] - r[1] * p[7]) + (r[8] * p[2] - r[2] * p[8]),
        (r[0] * p[3] - r[3] * p[0]) + (r[1] * p[4] - r[4] * p[1]) + (r[2] * p[5] - r[5] * p[2]),
    )


@jit_inline
def write_hinge_turns(rig, offsets, workspace):
    """How the weight of each hinge channel changes as its joint is turned from the left."""
    for h in range(len(rig.hinge_joint)):
        turned = load9(workspace, offsets.local + 9 * rig.hinge_joint[h])
        by = load(workspace, offsets.fold + 5 * h + 1)
        turns = scale3(by, slope(rig.hinge_rows[h], turned))
        store3(workspace, offsets.fold + 5 * h + 2, turns)


@jit_inline
def write_blends(rig, offsets, workspace):
    """sum_k w_ik G_k of every corner."""
    for u in range(len(rig.rest_corners)):
        x = spread3(workspace, 0.0, 0.0, 0.0)
        y = spread3(workspace, 0.0, 0.0, 0.0)
        z = spread3(workspace, 0.0, 0.0, 0.0)
        for k in range(rig.influence_start[u], rig.influence_start[u + 1]):
            m = load9(workspace, offsets.world + 9 * rig.influence_joint[k])
            w = rig.influence_weight[k]
            x = add3(x, scale3(w, (m[0], m[1], m[2])))
            y = add3(y, scale3(w, (m[3], m[4], m[5])))
            z = add3(z, scale3(w, (m[6], m[7], m[8])))
        store9(
            workspace, offsets.blend + 9 * u, (x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])
        )


@jit_inline
def corner_arm(slots, offsets, workspace, part, place):
    """sum over a corner's influences below the joint of u_ik - w_ik p_j."""
    total = scale3(spread(workspace, -slots.part_weight[part]), place)
    for k in range(slots.part_start[part], slots.part_start[part + 1]):
        total = add3(total, load3(workspace, offsets.carried + 3 * slots.part_influence[k]))
    return total


@jit_inline
def beta_columns(rig, offsets, workspace, i, carriage, first):
    """Columns of three betas."""
    x = beta_column(rig, offsets, workspace, i, carriage, first)
    y = beta_column(rig, offsets, workspace, i, carriage, first + 1)
    return x, y, beta_column(rig, offsets, workspace, i, carriage, first + 2)


@jit_inline
def beta_column(rig, offsets, workspace, i, carriage, b):
    """dx with beta b, from the derivatives of the three corners."""
    count = rig.corner_shapedirs.shape[2]
    a = load3(workspace, offsets.corner_by_shape + 3 * (rig.triangles[i, 0] * count + b))
    e = sub3(load3(workspace, offsets.corner_by_shape + 3 * (rig.triangles[i, 1] * count + b)), a)
    f = sub3(load3(workspace, offsets.corner_by_shape + 3 * (rig.triangles[i, 2] * count + b)), a)
    return carried_change(carriage, a, e, f)


@jit_inline
def write_shape_jacobian(rig, offsets, workspace):
    """How joints' offsets and then corners change with each beta."""
    dirs = rig.corner_shapedirs
    count = rig.corner_shapedirs.shape[2]
    if count + len(rig.posedir_joint) > 0:
        write_blends(rig, offsets, workspace)
    for b in range(count):
        write_joint_slopes(rig, offsets, workspace, b)
    for u in range(len(rig.rest_corners) if count > 0 else 0):
        blend = load9(workspace, offsets.blend + 9 * u)
        for b in range(count):
            total = turn3(blend, (dirs[u, 0, b], dirs[u, 1, b], dirs[u, 2, b]))
            for k in range(rig.influence_start[u], rig.influence_start[u + 1]):
                by_shape = load3(
                    workspace, offsets.joint_by_shape + 3 * (rig.influence_joint[k] * count + b)
                )
                total = add3(total, scale3(spread(workspace, rig.influence_weight[k]), by_shape))
            if b < rig.fold_shapes.shape[2]:
                total = add3(total, turn3(blend, fold_change(rig, offsets, workspace, u, b)))
            store3(workspace, offsets.corner_by_shape + 3 * (u * count + b), total)


@jit_inline
def write_joint_slopes(rig, offsets, workspace, b):
    """dp_j - G_j dJ_j of every joint for beta b; dp_j = dp_parent + G_parent d(J_j - J_parent)."""
    dirs = rig.joint_shapedirs
    count = rig.joint_shapedirs.shape[2]
    for j in range(len(rig.parents)):
        parent = rig.parents[j]
        change = spread3(workspace, dirs[j, 0, b], dirs[j, 1, b], dirs[j, 2, b])
        moved = change
        if parent >= 0:
            # with o = p - G J: dp_j = do_parent + G_parent dJ_j
            above = load3(workspace, offsets.joint_by_shape + 3 * (parent * count + b))
            moved = add3(above, turn3(load9(workspace, offsets.world + 9 * parent), change))
        moved = sub3(moved, turn3(load9(workspace, offsets.world + 9 * j), change))
        store3(workspace, offsets.joint_by_shape + 3 * (j * count + b), moved)
