"""How predicted markers change with pose, trans and betas, for LANES frames at once (see
`habitus.observe.lane_kernels`).

Columns are kept for a marker's slots only (`habitus.observe.lane_rig`). A triangle that turns rigidly about joint j
needs no corners: dx = m x (x - p_j) for each column m of M_j. Pose blend shapes come as a gradient, not as columns.
"""

from habitus.compiled import compiled
from habitus.lane_algebra import (
    add3,
    add_row3,
    clear,
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
from habitus.lanes import load, spread, store
from habitus.observe.lane_kernels import marker_frame


@compiled
def carried_change(frame, da, de, df):
    """dx of a marker whose corner a and sides e, f change (`plain_kernels.carry_slopes`)."""
    _, q, n, t, s, inverse, along, across = frame
    lift = inverse * dot3(n, de)
    x = scale3(inverse * dot3(s, de), cross3(n, q))
    y = scale3((dot3(n, df) - along * lift) / across, cross3(t, q))
    return sub3(add3(add3(da, x), y), scale3(lift, cross3(s, q)))


@compiled
def write_columns(rig, slots, at, room, i, weight):
    """Columns (3 x 3) of all slots of marker i, times `weight`."""
    frame, marker = marker_frame(rig, at, room, i), load3(room, at.marker + 3 * i)
    joints = len(rig.parents)
    for s in range(slots.start[i], slots.start[i + 1]):
        block = slots.block[s]
        if block > joints:
            x, y, z = beta_columns(rig, at, room, i, frame, 3 * (block - 1 - joints))
        else:
            axes, place = load9(room, at.axes + 9 * (block - 1)), load3(room, at.place + 3 * (block - 1))
            if slots.rigid[s] == 1:
                arm = sub3(marker, place)
                x = cross3((axes[0], axes[3], axes[6]), arm)
                y = cross3((axes[1], axes[4], axes[7]), arm)
                z = cross3((axes[2], axes[5], axes[8]), arm)
            else:
                a = corner_arm(slots, at, room, 3 * s, place)
                e = sub3(corner_arm(slots, at, room, 3 * s + 1, place), a)
                f = sub3(corner_arm(slots, at, room, 3 * s + 2, place), a)
                x = turned_change(frame, (axes[0], axes[3], axes[6]), a, e, f)
                y = turned_change(frame, (axes[1], axes[4], axes[7]), a, e, f)
                z = turned_change(frame, (axes[2], axes[5], axes[8]), a, e, f)
        x, y, z = scale3(weight, x), scale3(weight, y), scale3(weight, z)
        store9(room, at.columns + 9 * s, (x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]))


@compiled
def corner_arm(slots, at, room, part, place):
    """sum over a corner's influences below the joint of u_ik - w_ik p_j."""
    total = scale3(spread(-slots.part_weight[part]), place)
    for k in range(slots.part_start[part], slots.part_start[part + 1]):
        total = add3(total, load3(room, at.carried + 3 * slots.part_influence[k]))
    return total


@compiled
def turned_change(frame, axis, a, e, f):
    """dx where the corner and the sides turn about `axis` with these arms."""
    return carried_change(frame, cross3(axis, a), cross3(axis, e), cross3(axis, f))


@compiled
def beta_columns(rig, at, room, i, frame, first):
    """Columns of three betas."""
    x = beta_column(rig, at, room, i, frame, first)
    y = beta_column(rig, at, room, i, frame, first + 1)
    return x, y, beta_column(rig, at, room, i, frame, first + 2)


@compiled
def beta_column(rig, at, room, i, frame, b):
    """dx with beta b, from the slopes of the three corners."""
    count = rig.corner_shapedirs.shape[2]
    a = load3(room, at.slope + 3 * (rig.triangles[i, 0] * count + b))
    e = sub3(load3(room, at.slope + 3 * (rig.triangles[i, 1] * count + b)), a)
    f = sub3(load3(room, at.slope + 3 * (rig.triangles[i, 2] * count + b)), a)
    return carried_change(frame, a, e, f)


@compiled
def write_slopes(rig, at, room):
    """How joints' offsets and then corners change with each beta (`plain_kernels.add_shape_slopes`)."""
    count = rig.corner_shapedirs.shape[2]
    for b in range(count):
        write_joint_slopes(rig, at, room, b)
    for u in range(len(rig.rest_corners) if count > 0 else 0):
        blend = blended_rotation(rig, at, room, u)
        for b in range(count):
            d = rig.corner_shapedirs[u, :, b]
            total = turn3(blend, spread3(d))
            for k in range(rig.influence_start[u], rig.influence_start[u + 1]):
                slope = load3(room, at.joint_slope + 3 * (rig.influence_joint[k] * count + b))
                total = add3(total, scale3(spread(rig.influence_weight[k]), slope))
            store3(room, at.slope + 3 * (u * count + b), total)


@compiled
def write_joint_slopes(rig, at, room, b):
    """dp_j - G_j dJ_j of every joint for beta b; dp_j = dp_parent + G_parent d(J_j - J_parent)."""
    count = rig.joint_shapedirs.shape[2]
    for j in range(len(rig.parents)):
        d, parent = rig.joint_shapedirs[j, :, b], rig.parents[j]
        change = spread3(d)
        moved = change
        if parent >= 0:
            # with o = p - G J: dp_j = do_parent + G_parent dJ_j
            above = load3(room, at.joint_slope + 3 * (parent * count + b))
            moved = add3(above, turn3(load9(room, at.world + 9 * parent), change))
        moved = sub3(moved, turn3(load9(room, at.world + 9 * j), change))
        store3(room, at.joint_slope + 3 * (j * count + b), moved)


@compiled
def blended_rotation(rig, at, room, u):
    """sum_k w_ik G_k of corner u."""
    first = rig.influence_start[u]
    m = load9(room, at.world + 9 * rig.influence_joint[first])
    w = spread(rig.influence_weight[first])
    x, y, z = scale3(w, (m[0], m[1], m[2])), scale3(w, (m[3], m[4], m[5])), scale3(w, (m[6], m[7], m[8]))
    for k in range(first + 1, rig.influence_start[u + 1]):
        m, w = load9(room, at.world + 9 * rig.influence_joint[k]), spread(rig.influence_weight[k])
        x = add3(x, scale3(w, (m[0], m[1], m[2])))
        y = add3(y, scale3(w, (m[3], m[4], m[5])))
        z = add3(z, scale3(w, (m[6], m[7], m[8])))
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]


@compiled
def add_force(rig, at, room, i, force):
    """Hand dE/dx of marker i to its corners: the transpose of `carried_change`, added to the rows `force`."""
    _, q, n, t, s, inverse, along, across = marker_frame(rig, at, room, i)
    twist = dot3(cross3(t, q), force) / across
    lift = inverse * (dot3(cross3(s, q), force) + along * twist)
    side = inverse * dot3(cross3(n, q), force)
    e, f = sub3(scale3(side, s), scale3(lift, n)), scale3(twist, n)
    add_row3(room, at.force + 3 * rig.triangles[i, 0], sub3(sub3(force, e), f))
    add_row3(room, at.force + 3 * rig.triangles[i, 1], e)
    add_row3(room, at.force + 3 * rig.triangles[i, 2], f)


@compiled
def add_posedirs_gradient(rig, at, room):
    """Add to the gradient what the forces on the corners do through the pose blend shapes.

    With h_i = (sum_k w_ik G_k)^T force_i and A = sum_i P_ij^T h_i (3 x 3), dE = A : dR, and dR = [L d]x R makes the
    gradient L^T sum_c R_c x A_c over the columns c.
    """
    clear(room, at.twist, at.twist + 9 * len(rig.parents))
    for u in range(len(rig.rest_corners)):
        h = turn_back3(blended_rotation(rig, at, room, u), load3(room, at.force + 3 * u))
        for d in range(rig.posedir_start[u], rig.posedir_start[u + 1]):
            row, p = at.twist + 9 * rig.posedir_joint[d], rig.posedirs[d]
            for e in range(9):
                store(room, row + e, load(room, row + e) + (p[0, e] * h[0] + p[1, e] * h[1] + p[2, e] * h[2]))
    for j in range(1, len(rig.parents)):
        r, a = load9(room, at.local + 9 * j), load9(room, at.twist + 9 * j)
        torque = add3(
            add3(cross3((r[0], r[3], r[6]), (a[0], a[3], a[6])), cross3((r[1], r[4], r[7]), (a[1], a[4], a[7]))),
            cross3((r[2], r[5], r[8]), (a[2], a[5], a[8])),
        )
        add_row3(room, at.gradient + 3 + 3 * j, turn_back3(load9(room, at.left + 9 * j), torque))
