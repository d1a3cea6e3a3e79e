"""Cost, gradient and Gauss-Newton matrix of a robot's pose, frame by frame: directions of links,
places of points, the floor, and links that keep clear of one another.

A state is the root's shift (m) and turn (rotation vector) from its reference, then joint angles.
"""

import numpy as np

from habitus.kernels.jit import jit


@jit
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@jit
def _rotate(turn, v, out):
    for i in range(3):
        out[i] = turn[i, 0] * v[0] + turn[i, 1] * v[1] + turn[i, 2] * v[2]


@jit
def _turn_about(axis, angle, out):
    """Rodrigues' matrix of a unit axis."""
    s, c = np.sin(angle), np.cos(angle)
    x, y, z = axis
    v = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = c + v * x * x, v * x * y - s * z, v * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = v * x * y + s * z, c + v * y * y, v * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = v * x * z - s * y, v * y * z + s * x, c + v * z * z


@jit
def _product(a, b, out):
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@jit
def _root(state, reference, turn, about):
    """Rotation of the root link, and the world axes about which its three angles turn it (rows)."""
    angle = np.sqrt(state[3] ** 2 + state[4] ** 2 + state[5] ** 2)
    axis = np.array([1.0, 0.0, 0.0])
    if angle > 1e-12:
        axis[:] = state[3:6] / angle
    own = np.empty((3, 3))
    _turn_about(axis, angle, own)
    _product(own, reference, turn)
    a = 0.5 - angle**2 / 24.0  # (1 - cos) / angle^2
    b = 1.0 / 6.0 - angle**2 / 120.0  # (angle - sin) / angle^3
    if angle > 1e-3:
        a = (1.0 - np.cos(angle)) / angle**2
        b = (angle - np.sin(angle)) / angle**3
    v = state[3:6]
    for k in range(3):
        e = np.zeros(3)
        e[k] = 1.0
        once, twice = np.empty(3), np.empty(3)
        _cross(v, e, once)
        _cross(v, once, twice)
        about[k] = e + a * once + b * twice


@jit
def place_links(robot, state, reference, start, work):
    """Rotations and origins of all links, and axes and anchors of all that turns, in the world."""
    _root(state, reference, work.turns[0], work.axes[:3])
    for i in range(3):
        work.origins[0, i] = start[i] + state[i]
        for k in range(3):
            work.anchors[k, i] = work.origins[0, i]
    frame, own, shift = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for link in range(1, len(robot.parents)):
        above = robot.parents[link]
        _product(work.turns[above], robot.turns[link], frame)
        _rotate(work.turns[above], robot.offsets[link], shift)
        origin = work.origins[link]
        for i in range(3):
            origin[i] = work.origins[above, i] + shift[i]
        k = robot.joint_of_link[link]
        if k < 0:
            work.turns[link] = frame
            continue
        _rotate(frame, robot.axes[k], work.axes[3 + k])
        _rotate(frame, robot.anchors[k], shift)
        for i in range(3):
            work.anchors[3 + k, i] = origin[i] + shift[i]
        _turn_about(robot.axes[k], state[6 + k], own)
        _product(frame, own, work.turns[link])
        _rotate(work.turns[link], robot.anchors[k], shift)
        for i in range(3):
            origin[i] = work.anchors[3 + k, i] - shift[i]


@jit
def _point(work, link, local, out):
    _rotate(work.turns[link], local, out)
    for i in range(3):
        out[i] += work.origins[link, i]


@jit
def _columns(robot, work, link, place, free, columns, used):
    """Derivatives of a point that moves with a link, or of a direction where not ``free``; how many
    unknowns move it.
    """
    count = 0
    if free:
        for k in range(3):
            columns[k] = 0.0
            columns[k, k] = 1.0
            used[k] = k
        count = 3
    arm = np.empty(3)
    for m in range(robot.path_starts[link], robot.path_starts[link + 1]):
        j = robot.path_axes[m]
        for i in range(3):
            arm[i] = place[i] - work.anchors[j, i] if free else place[i]
        _cross(work.axes[j], arm, columns[count])
        used[count] = 3 + j
        count += 1
    return count


@jit
def _add(columns, used, count, residual, weight, weight_up, gradient, matrix):
    """Add a residual of two level rows and an upright one to the normal equations (lower
    triangle).
    """
    for a in range(count):
        x, y, z = columns[a, 0], columns[a, 1], columns[a, 2]
        i = used[a]
        gradient[i] += weight * (x * residual[0] + y * residual[1])
        gradient[i] += weight_up * z * residual[2]
        for b in range(a + 1):
            matrix[i, used[b]] += weight * (x * columns[b, 0] + y * columns[b, 1])
            matrix[i, used[b]] += weight_up * z * columns[b, 2]


@jit
def _add_row(columns, used, count, along, residual, weight, gradient, matrix):
    """Add one row, the derivative of a place along a direction."""
    row = np.empty(count)
    for a in range(count):
        row[a] = _dot(columns[a], along)
    for a in range(count):
        gradient[used[a]] += weight * row[a] * residual
        for b in range(count):
            if used[b] <= used[a]:
                matrix[used[a], used[b]] += weight * row[a] * row[b]


@jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def _share(value):
    return min(max(value, 0.0), 1.0)


@jit
def _nearest(p, q, r, s):
    """Shares of the segments pq and rs at which they come nearest to each other."""
    a = e = f = c = b = 0.0
    for i in range(3):
        u, v, w = q[i] - p[i], s[i] - r[i], p[i] - r[i]
        a, e, f, c, b = a + u * u, e + v * v, f + v * w, c + u * w, b + u * v
    if a < 1e-12:
        return 0.0, (_share(f / e) if e > 1e-12 else 0.0)
    if e < 1e-12:
        return _share(-c / a), 0.0
    spread = a * e - b * b
    x = _share((b * f - c * e) / spread) if spread > 1e-12 else 0.0
    y = (b * x + f) / e
    if y < 0.0:
        return _share(-c / a), 0.0
    if y > 1.0:
        return _share((b - c) / a), 1.0
    return x, y


@jit
def _across(p, q, r, s, out):
    """The direction square to two segments that cross; up where they are parallel."""
    _cross(q - p, s - r, out)
    length = np.sqrt(_dot(out, out))
    if length > 1e-9:
        out /= length
    else:
        out[0], out[1], out[2] = 0.0, 0.0, 1.0


@jit
def _far(ends, lengths, a, b, reach):
    """Whether two segments cannot be as near as ``reach``: their middles are too far apart."""
    square = 0.0
    for i in range(3):
        square += (ends[a, 0, i] + ends[a, 1, i] - ends[b, 0, i] - ends[b, 1, i]) ** 2
    return square > (2.0 * reach + lengths[a] + lengths[b]) ** 2


@jit
def frame_terms(robot, goal, frame, state, work, derive, gradient, matrix):
    """Cost of a frame, half the sum of weighted squares; its derivatives are added where asked
    for.
    """
    place_links(robot, state, goal.references[frame], goal.starts[frame], work)
    columns, used = work.columns, work.used
    here, residual = np.empty(3), np.empty(3)
    cost = 0.0
    for d in range(len(goal.direction_links)):
        link, weight = goal.direction_links[d], goal.direction_weights[d]
        _rotate(work.turns[link], goal.direction_axes[d], here)
        for i in range(3):
            residual[i] = here[i] - goal.directions[frame, d, i]
            cost += 0.5 * weight * residual[i] ** 2
        if derive:
            count = _columns(robot, work, link, here, False, columns, used)
            _add(columns, used, count, residual, weight, weight, gradient, matrix)
    for p in range(len(goal.point_links)):
        link = goal.point_links[p]
        weight, weight_up = goal.point_weights[frame, p], goal.point_up_weights[frame, p]
        if weight == 0.0 and weight_up == 0.0:
            continue
        _point(work, link, goal.point_places[p], here)
        for i in range(3):
            residual[i] = here[i] - goal.points[frame, p, i]
        cost += 0.5 * weight * (residual[0] ** 2 + residual[1] ** 2)
        cost += 0.5 * weight_up * residual[2] ** 2
        if derive:
            count = _columns(robot, work, link, here, True, columns, used)
            _add(columns, used, count, residual, weight, weight_up, gradient, matrix)
    up = np.array([0.0, 0.0, 1.0])
    for f in range(len(goal.floor_links)):
        link = goal.floor_links[f]
        _point(work, link, goal.floor_places[f], here)
        below = here[2] - goal.floor_radii[f]
        if below < 0.0:
            cost += 0.5 * goal.floor_weight * below**2
            if derive:
                count = _columns(robot, work, link, here, True, columns, used)
                _add_row(columns, used, count, up, below, goal.floor_weight, gradient, matrix)
    cost += _clearance(robot, goal, work, derive, gradient, matrix)
    for i in range(len(state)):
        off = state[i] - goal.neutral[i]
        cost += 0.5 * goal.neutral_weights[i] * off**2
        if derive:
            gradient[i] += goal.neutral_weights[i] * off
            matrix[i, i] += goal.neutral_weights[i]
    return cost


@jit
def _clearance(robot, goal, work, derive, gradient, matrix):
    """Cost of capsules that enter one another."""
    cost = 0.0
    ends = work.ends
    for c in range(len(goal.capsule_links)):
        for k in range(2):
            _point(work, goal.capsule_links[c], goal.capsule_ends[c, k], ends[c, k])
    here, there, away = np.empty(3), np.empty(3), np.empty(3)
    columns, used = work.columns, work.used
    count_all = 3 + len(work.axes)
    for pair in range(len(goal.pairs)):
        a, b = goal.pairs[pair, 0], goal.pairs[pair, 1]
        reach = goal.capsule_radii[a] + goal.capsule_radii[b]
        if _far(ends, goal.capsule_lengths, a, b, reach):
            continue
        x, y = _nearest(ends[a, 0], ends[a, 1], ends[b, 0], ends[b, 1])
        square = 0.0
        for i in range(3):
            here[i] = ends[a, 0, i] + x * (ends[a, 1, i] - ends[a, 0, i])
            there[i] = ends[b, 0, i] + y * (ends[b, 1, i] - ends[b, 0, i])
            away[i] = here[i] - there[i]
            square += away[i] ** 2
        if square >= reach**2:
            continue
        distance = np.sqrt(square)
        if distance > 1e-6:
            away /= distance
        else:
            _across(ends[a, 0], ends[a, 1], ends[b, 0], ends[b, 1], away)
        cost += 0.5 * goal.clearance_weight * (distance - reach) ** 2
        if derive:
            row = np.zeros(count_all)
            count = _columns(robot, work, goal.capsule_links[a], here, True, columns, used)
            for k in range(count):
                row[used[k]] += _dot(columns[k], away)
            count = _columns(robot, work, goal.capsule_links[b], there, True, columns, used)
            for k in range(count):
                row[used[k]] -= _dot(columns[k], away)
            for i in range(count_all):
                if row[i] != 0.0:
                    pull = goal.clearance_weight * row[i]
                    gradient[i] += pull * (distance - reach)
                    for j in range(i + 1):
                        matrix[i, j] += pull * row[j]
    return cost


@jit
def frame_costs(robot, goal, frames, states, work, out):
    """Costs of frames (F,)."""
    nothing, none = np.empty(0), np.empty((0, 0))
    for k in range(len(frames)):
        out[k] = frame_terms(robot, goal, frames[k], states[k], work, False, nothing, none)


@jit
def linearized(robot, goal, frames, states, work, costs, gradients, matrices):
    """Costs (F,), gradients (F, N) and Gauss-Newton matrices (F, N, N) of frames."""
    gradients[:] = 0.0
    matrices[:] = 0.0
    size = states.shape[1]
    for k in range(len(frames)):
        costs[k] = frame_terms(
            robot, goal, frames[k], states[k], work, True, gradients[k], matrices[k]
        )
        for i in range(size):
            for j in range(i):
                matrices[k, j, i] = matrices[k, i, j]
