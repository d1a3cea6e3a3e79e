"""Vertices of a body and how they move, and rows of the Jacobian of points on its triangles,
compiled (LBS).

The formulas are those of `habitus.body.jacobians`; of each vertex only the joints are kept that
move it.
"""

from habitus.kernels.jit import jit_inline, jit_noalloc


@jit_noalloc
def move_vertices(rig, state, used, vertices, by_betas, by_pose, room):
    """Places (V, 3), derivatives by betas (V, 3, B) and by the vertex' own joints (S, 9) of the
    vertices ``used``.

    room: (4, 3) numbers to work with.
    """
    betas = by_betas.shape[2]
    joints = len(state.joints)
    for n in range(len(used)):
        i = used[n]
        _rest(rig, state, i, room[0])
        turn = room[1:4]
        _blend(rig, state, i, room[0], turn, vertices[i])
        for c in range(3):
            for b in range(betas):
                by_betas[i, c, b] = 0.0
            for d in range(3):
                share = turn[c, d]
                for b in range(betas):
                    by_betas[i, c, b] += share * rig.shapedirs[i, d, b]
            for k in range(rig.index.shape[1]):
                share = rig.value[i, k]
                shift = state.shifts[rig.index[i, k]]
                if share != 0.0:
                    for b in range(betas):
                        by_betas[i, c, b] += share * shift[c, b]
        for s in range(rig.start[i], rig.start[i + 1]):
            feature = rig.feature[s]
            if feature < joints:
                _by_joint(rig, state, i, rig.joint[s], room[0], by_pose[s])
            else:
                by_pose[s] = 0.0
                _add_by_betas(
                    rig.value_shapes[rig.shape[s]],
                    state.hinges_by_betas[feature - joints],
                    turn,
                    by_betas[i],
                )
            if rig.shape[s] >= 0:
                _add_pose_shape(
                    rig.value_shapes[rig.shape[s]], state.change[feature], turn, by_pose[s]
                )


@jit_noalloc
def place_vertices(rig, state, used, vertices, room):
    """Places (V, 3) of the vertices ``used``, without derivatives; room: (4, 3) to work with."""
    for n in range(len(used)):
        i = used[n]
        _rest(rig, state, i, room[0])
        _blend(rig, state, i, room[0], room[1:4], vertices[i])


@jit_noalloc
def points_cost(rig, vertices, points):
    """1/2 sum of the squared products of q - target with each direction."""
    total = 0.0
    for p in range(len(points.face)):
        face = rig.faces[points.face[p]]
        for d in range(points.directions.shape[1]):
            off = 0.0
            for c in range(3):
                q = -points.target[p, c]
                for k in range(3):
                    q += points.barycentric[p, k] * vertices[face[k], c]
                off += points.directions[p, d, c] * q
            total += off * off
    return 0.5 * total


@jit_inline
def _rest(rig, state, i, rest):
    """The vertex at rest: template, shape and pose blend shapes."""
    for c in range(3):
        total = rig.template[i, c]
        for b in range(len(state.betas)):
            total += rig.shapedirs[i, c, b] * state.betas[b]
        rest[c] = total
    for s in range(rig.start[i], rig.start[i + 1]):
        g = rig.shape[s]
        if g >= 0:
            feature = state.feature[rig.feature[s]]
            for e in range(9):
                for c in range(3):
                    rest[c] += rig.value_shapes[g, 3 * e + c] * feature[e]


@jit_inline
def _blend(rig, state, i, rest, turn, place):
    """The vertex' blended rotation, and where it is."""
    for c in range(3):
        place[c] = state.trans[c]
        for d in range(3):
            turn[c, d] = 0.0
    for k in range(rig.index.shape[1]):
        share = rig.value[i, k]
        motion = state.motions[rig.index[i, k]]
        for c in range(3):
            place[c] += share * motion[c, 3]
            for d in range(3):
                turn[c, d] += share * motion[c, d]
    for c in range(3):
        for d in range(3):
            place[c] += turn[c, d] * rest[d]


@jit_inline
def _by_joint(rig, state, i, j, rest, out):
    """-[lever]x turns of joint j: what hangs on it turns about it."""
    x = y = z = share = 0.0
    for k in range(rig.index.shape[1]):
        w = rig.value[i, k]
        joint = rig.index[i, k]
        if w != 0.0 and state.below[j, joint] != 0.0:
            m = state.motions[joint]
            share += w
            x += w * (m[0, 0] * rest[0] + m[0, 1] * rest[1] + m[0, 2] * rest[2] + m[0, 3])
            y += w * (m[1, 0] * rest[0] + m[1, 1] * rest[1] + m[1, 2] * rest[2] + m[1, 3])
            z += w * (m[2, 0] * rest[0] + m[2, 1] * rest[1] + m[2, 2] * rest[2] + m[2, 3])
    x = x - share * state.joints[j, 0]
    y = y - share * state.joints[j, 1]
    z = z - share * state.joints[j, 2]
    turns = state.turns[j]
    for e in range(3):
        a = turns[0, e]
        b = turns[1, e]
        c = turns[2, e]
        out[e], out[3 + e], out[6 + e] = b * z - c * y, c * x - a * z, a * y - b * x


@jit_inline
def _add_pose_shape(shapes, change, turn, out):
    for e in range(3):
        x = y = z = 0.0
        for f in range(9):
            by = change[f, e]
            x += shapes[3 * f] * by
            y += shapes[3 * f + 1] * by
            z += shapes[3 * f + 2] * by
        for c in range(3):
            out[3 * c + e] += turn[c, 0] * x + turn[c, 1] * y + turn[c, 2] * z


@jit_inline
def _add_by_betas(shapes, by, turn, out):
    """Hinges are multiplied with the first betas."""
    for b in range(by.shape[1]):
        x = y = z = 0.0
        for f in range(9):
            x += shapes[3 * f] * by[f, b]
            y += shapes[3 * f + 1] * by[f, b]
            z += shapes[3 * f + 2] * by[f, b]
        for c in range(3):
            out[c, b] += turn[c, 0] * x + turn[c, 1] * y + turn[c, 2] * z


@jit_noalloc
def write_rows(rig, table, points, some, column, rows, residual):
    """Rows of the Jacobian, and residuals, of the points ``some``, as many for each as it has
    directions.

    column: (J,) where the three columns of each joint begin; those of betas and trans come first.
    """
    betas = table.by_betas.shape[2]
    directions = points.directions.shape[1]
    rows[:] = 0.0
    for n in range(len(some)):
        p = some[n]
        face = rig.faces[points.face[p]]
        for d in range(directions):
            x = points.directions[p, d, 0]
            y = points.directions[p, d, 1]
            z = points.directions[p, d, 2]
            row = rows[n * directions + d]
            row[betas], row[betas + 1], row[betas + 2] = x, y, z
            off = -(x * points.target[p, 0] + y * points.target[p, 1] + z * points.target[p, 2])
            for k in range(3):
                i = face[k]
                share = points.barycentric[p, k]
                if share == 0.0:
                    continue
                a = share * x
                b = share * y
                c = share * z
                off += (
                    a * table.vertices[i, 0] + b * table.vertices[i, 1] + c * table.vertices[i, 2]
                )
                by = table.by_betas[i]
                for e in range(betas):
                    row[e] += a * by[0, e] + b * by[1, e] + c * by[2, e]
                for s in range(rig.start[i], rig.start[i + 1]):
                    first = column[rig.joint[s]]
                    by_joint = table.by_pose[s]
                    for e in range(3):
                        row[first + e] += (
                            a * by_joint[e] + b * by_joint[3 + e] + c * by_joint[6 + e]
                        )
            residual[n * directions + d] = off


@jit_noalloc
def place_points(faces, vertices, face, barycentric, out):
    """Points on triangles."""
    for p in range(len(face)):
        corners = faces[face[p]]
        for c in range(3):
            out[p, c] = (
                barycentric[p, 0] * vertices[corners[0], c]
                + barycentric[p, 1] * vertices[corners[1], c]
                + barycentric[p, 2] * vertices[corners[2], c]
            )


@jit_noalloc
def mark_corners(faces, face, marked):
    """Set `marked` at the corners of these faces."""
    for p in range(len(face)):
        for k in range(3):
            marked[faces[face[p], k]] = True
