"""Normal equations of frames that cameras see as keypoints, and one damped step of each: the
compiled form of `habitus.fit.cameras.sequence.KeypointSequence.linearize` and of
`habitus.solve.sequence.DenseVisits.visit`.

    f = 1/2 sum_ck w_ck rho(|r_ck|^2) + 1/2 sum_k v_k rho_3(|q_k - t_k|^2)
        + 1/2 (z - mean)^T precision (z - mean)

r_ck: pixels of keypoint k in camera c, expected less observed; w, v: information (1 / px^2, 1 /
m^2), 0 where nothing was seen. rho(s) = s / (1 + w s / h^2): Geman-McClure's of h standard
deviations, so that a detection weighs at most h^2. All cameras of a keypoint become one 3 x 3
information and one pull on its point; the matrix is then that of points on a skeleton.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.kernels.jit import jit_inline, jit_noalloc

NEAR = 0.1


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


class KeypointScratch(NamedTuple):
    """Room for one frame."""

    world: Float[np.ndarray, "J 3 3"]
    axes: Float[np.ndarray, "J 3 3"]
    at: Float[np.ndarray, "J 3"]
    gradient: Float[np.ndarray, " N"]
    matrix: Float[np.ndarray, "N N"]
    step: Float[np.ndarray, " N"]
    trial: Float[np.ndarray, " N"]
    information: Float[np.ndarray, "3 3"]
    pull: Float[np.ndarray, "3"]
    arms: Float[np.ndarray, "J 3 3"]
    """Of each joint above a point, how its rotation vector moves it."""
    informed: Float[np.ndarray, "3 3"]

    @staticmethod
    def of(joints: int) -> "KeypointScratch":
        """For so many joints."""
        size = 3 + 3 * joints
        return KeypointScratch(
            np.empty((joints, 3, 3)),
            np.empty((joints, 3, 3)),
            np.empty((joints, 3)),
            np.empty(size),
            np.empty((size, size)),
            np.empty(size),
            np.empty(size),
            np.empty((3, 3)),
            np.empty(3),
            np.empty((joints, 3, 3)),
            np.empty((3, 3)),
        )


@jit_inline
def _turn(vector, rotation, axes):
    """The matrix of a rotation vector, and its left Jacobian."""
    x, y, z = vector[0], vector[1], vector[2]
    s = x * x + y * y + z * z
    if s < 1e-8:
        a, b, c = 1.0 - s / 6.0, 0.5 - s / 24.0, 1.0 / 6.0 - s / 120.0
    else:
        t = np.sqrt(s)
        a, b, c = np.sin(t) / t, (1.0 - np.cos(t)) / s, (t - np.sin(t)) / (s * t)
    rotation[0, 0] = 1.0 - b * (y * y + z * z)
    rotation[0, 1] = b * x * y - a * z
    rotation[0, 2] = b * x * z + a * y
    rotation[1, 0] = b * x * y + a * z
    rotation[1, 1] = 1.0 - b * (x * x + z * z)
    rotation[1, 2] = b * y * z - a * x
    rotation[2, 0] = b * x * z - a * y
    rotation[2, 1] = b * y * z + a * x
    rotation[2, 2] = 1.0 - b * (x * x + y * y)
    axes[0, 0] = 1.0 - c * (y * y + z * z)
    axes[0, 1] = c * x * y - b * z
    axes[0, 2] = c * x * z + b * y
    axes[1, 0] = c * x * y + b * z
    axes[1, 1] = 1.0 - c * (x * x + z * z)
    axes[1, 2] = c * y * z - b * x
    axes[2, 0] = c * x * z - b * y
    axes[2, 1] = c * y * z + b * x
    axes[2, 2] = 1.0 - c * (x * x + y * y)


@jit_inline
def _place(data, room, state):
    """World rotations, axes and places of all joints."""
    for j in range(len(data.parents)):
        _turn(state[3 + 3 * j : 6 + 3 * j], room.world[j], room.axes[j])
        p = data.parents[j]
        if p < 0:
            for i in range(3):
                room.at[j, i] = data.joints[j, i] + state[i]
            continue
        for i in range(3):
            total = room.at[p, i]
            for m in range(3):
                total += room.world[p, i, m] * (data.joints[j, m] - data.joints[p, m])
            room.at[j, i] = total
        for table in (room.world[j], room.axes[j]):
            for c in range(3):
                x, y, z = table[0, c], table[1, c], table[2, c]
                for i in range(3):
                    table[i, c] = (
                        room.world[p, i, 0] * x + room.world[p, i, 1] * y + room.world[p, i, 2] * z
                    )


@jit_inline
def _point(data, room, k):
    """Keypoint k in the world."""
    b = data.bone[k]
    x, y, z = data.places[k, 0], data.places[k, 1], data.places[k, 2]
    return (
        room.at[b, 0] + room.world[b, 0, 0] * x + room.world[b, 0, 1] * y + room.world[b, 0, 2] * z,
        room.at[b, 1] + room.world[b, 1, 0] * x + room.world[b, 1, 1] * y + room.world[b, 1, 2] * z,
        room.at[b, 2] + room.world[b, 2, 0] * x + room.world[b, 2, 1] * y + room.world[b, 2, 2] * z,
    )


@jit_inline
def _observe(data, room, t, k, q, second):
    """The cost of keypoint k in frame t; with ``second`` its information and pull too."""
    cost = 0.0
    if second:
        for i in range(3):
            room.pull[i] = 0.0
            for m in range(3):
                room.information[i, m] = 0.0
    least = 1.0 / (data.reach * data.reach)
    for c in range(len(data.focal)):
        w = data.weights[t, c, k]
        if w == 0.0:
            continue
        turn = data.rotation[c]
        x = turn[0, 0] * q[0] + turn[0, 1] * q[1] + turn[0, 2] * q[2] + data.translation[c, 0]
        y = turn[1, 0] * q[0] + turn[1, 1] * q[1] + turn[1, 2] * q[2] + data.translation[c, 1]
        z = turn[2, 0] * q[0] + turn[2, 1] * q[1] + turn[2, 2] * q[2] + data.translation[c, 2]
        if z < NEAR:
            cost += 0.5 * data.reach * data.reach
            continue
        fx, fy = data.focal[c, 0] / z, data.focal[c, 1] / z
        u = fx * x + data.centre[c, 0] - data.pixels[t, c, k, 0]
        v = fy * y + data.centre[c, 1] - data.pixels[t, c, k, 1]
        squared = u * u + v * v
        share = 1.0 / (1.0 + w * squared * least)
        cost += 0.5 * w * share * squared
        if second:
            weight = w * share * share
            for i in range(3):
                gu = fx * (turn[0, i] - x / z * turn[2, i])
                gv = fy * (turn[1, i] - y / z * turn[2, i])
                room.pull[i] += weight * (gu * u + gv * v)
                for m in range(3):
                    hu = fx * (turn[0, m] - x / z * turn[2, m])
                    hv = fy * (turn[1, m] - y / z * turn[2, m])
                    room.information[i, m] += weight * (gu * hu + gv * hv)
    w = data.point_weights[t, k]
    if w > 0.0:
        x = q[0] - data.points[t, k, 0]
        y = q[1] - data.points[t, k, 1]
        z = q[2] - data.points[t, k, 2]
        squared = x * x + y * y + z * z
        share = 1.0 / (1.0 + w * squared * least)
        cost += 0.5 * w * share * squared
        if second:
            weight = w * share * share
            for i in range(3):
                room.information[i, i] += weight
            room.pull[0] += weight * x
            room.pull[1] += weight * y
            room.pull[2] += weight * z
    return cost


@jit_inline
def _prior(data, room, state, second):
    cost = 0.0
    size = len(data.mean)
    for r in range(6, size):
        slope = 0.0
        for c in range(6, size):
            slope += data.precision[r, c] * (state[c] - data.mean[c])
        cost += 0.5 * slope * (state[r] - data.mean[r])
        if second:
            room.gradient[r] += slope
    return cost


@jit_noalloc
def frame_cost(data, room, t, state):
    """f of one frame."""
    _place(data, room, state)
    cost = _prior(data, room, state, False)
    for k in range(len(data.bone)):
        cost += _observe(data, room, t, k, _point(data, room, k), False)
    return cost


@jit_noalloc
def linearize_frame(data, room, t, state):
    """f of one frame; its gradient and the lower triangle of its matrix in the scratch."""
    size = len(data.mean)
    _place(data, room, state)
    for r in range(size):
        room.gradient[r] = 0.0
        for c in range(r + 1):
            room.matrix[r, c] = data.precision[r, c]
    cost = _prior(data, room, state, True)
    for k in range(len(data.bone)):
        q = _point(data, room, k)
        cost += _observe(data, room, t, k, q, True)
        for i in range(3):
            room.gradient[i] += room.pull[i]
            for m in range(i + 1):
                room.matrix[i, m] += room.information[i, m]
        j = data.bone[k]
        while j >= 0:
            _add_joint(data, room, k, j, q)
            j = data.parents[j]
    return cost


@jit_inline
def _add_joint(data, room, k, j, q):
    """What joint j, above keypoint k, adds: with place, with itself, and with the joints below it
    on the way to the keypoint.
    """
    x, y, z = q[0] - room.at[j, 0], q[1] - room.at[j, 1], q[2] - room.at[j, 2]
    arm = room.arms[j]
    for c in range(3):
        a, b, e = room.axes[j, 0, c], room.axes[j, 1, c], room.axes[j, 2, c]
        arm[0, c] = b * z - e * y
        arm[1, c] = e * x - a * z
        arm[2, c] = a * y - b * x
    row = 3 + 3 * j
    for c in range(3):
        room.gradient[row + c] += (
            arm[0, c] * room.pull[0] + arm[1, c] * room.pull[1] + arm[2, c] * room.pull[2]
        )
        for i in range(3):
            room.informed[i, c] = (
                room.information[i, 0] * arm[0, c]
                + room.information[i, 1] * arm[1, c]
                + room.information[i, 2] * arm[2, c]
            )
            room.matrix[row + c, i] += room.informed[i, c]
    for c in range(3):
        for m in range(c + 1):
            room.matrix[row + c, row + m] += (
                arm[0, m] * room.informed[0, c]
                + arm[1, m] * room.informed[1, c]
                + arm[2, m] * room.informed[2, c]
            )
    below = data.bone[k]
    while below != j:
        other = room.arms[below]
        down = 3 + 3 * below
        for c in range(3):
            for m in range(3):
                room.matrix[down + c, row + m] += (
                    other[0, c] * room.informed[0, m]
                    + other[1, c] * room.informed[1, m]
                    + other[2, c] * room.informed[2, m]
                )
        below = data.parents[below]


@jit_inline
def _solve(room, size):
    """The step -matrix^-1 gradient by Cholesky, in place; False where the matrix is not positive
    definite.
    """
    m = room.matrix
    for r in range(size):
        for c in range(r + 1):
            total = m[r, c]
            for i in range(c):
                total -= m[r, i] * m[c, i]
            if r == c:
                if not total > 0.0:
                    return False
                m[r, r] = np.sqrt(total)
            else:
                m[r, c] = total / m[c, c]
    for r in range(size):
        total = -room.gradient[r]
        for c in range(r):
            total -= m[r, c] * room.step[c]
        room.step[r] = total / m[r, r]
    for r in range(size - 1, -1, -1):
        total = room.step[r]
        for c in range(r + 1, size):
            total -= m[c, r] * room.step[c]
        room.step[r] = total / m[r, r]
    return True


@jit_noalloc
def costs(data, room, frames, states, out):
    """f of several frames."""
    for k in range(len(frames)):
        out[k] = frame_cost(data, room, frames[k], states[k])


@jit_noalloc
def visit(data, room, level, block):
    """`habitus.solve.sequence.DenseVisits.visit` of the frames ``block`` of a level (frames,
    states, links, costs, damping, moved, cost_decrease, relaxations).
    """
    frames, states, links, level_costs, dampings, moved, decrease, relaxations = level
    size = len(data.mean)
    last = len(states) - 1
    for b in block:
        state = states[b]
        damping = dampings[b]
        relaxation = relaxations[b]
        cost = linearize_frame(data, room, frames[b], state)
        for n in range(size):
            here = state[n]
            first = states[max(b - 2, 0), n] - 2.0 * states[max(b - 1, 0), n] + here
            second = states[max(b - 1, 0), n] - 2.0 * here + states[min(b + 1, last), n]
            third = here - 2.0 * states[min(b + 1, last), n] + states[min(b + 2, last), n]
            la, lb, lc = links[b, n], links[b + 1, n], links[b + 2, n]
            room.trial[n] = la * first - 2.0 * lb * second + lc * third
            room.gradient[n] += room.trial[n]
            room.matrix[n, n] += la + 4.0 * lb + lc + damping + 1e-9
        good = np.isfinite(cost) and _solve(room, size)
        change, along, spent, square = 0.0, 0.0, 0.0, 0.0
        if good:
            for n in range(size):
                step = relaxation * room.step[n]
                stiffness = links[b, n] + 4.0 * links[b + 1, n] + links[b + 2, n]
                change += (room.trial[n] + 0.5 * stiffness * step) * step
                along -= room.gradient[n] * room.step[n]
                spent += damping * room.step[n] * room.step[n]
                if n >= 3:
                    square += room.step[n] * room.step[n]
            for n in range(size):
                room.trial[n] = state[n] + relaxation * room.step[n]
            trial = frame_cost(data, room, frames[b], room.trial)
            change += trial - cost
        if good and change < 1e-13 * cost:
            for n in range(size):
                state[n] = room.trial[n]
            level_costs[b] = trial
            decrease[b] = -change
            predicted = -relaxation * along + 0.5 * relaxation * relaxation * (along - spent)
            ratio = change / predicted if predicted != 0.0 else 0.0
            factor = 0.1 if ratio > 0.75 else (0.5 if ratio > 0.25 else 2.0)
            dampings[b] = damping * factor if damping > 1e-2 else 0.0
        else:
            level_costs[b] = cost
            decrease[b] = 0.0
            dampings[b] = min(max(8.0 * damping, 10.0), 1e12)
        longer = along / max(along - spent, 1e-6 * along) if along > 0.0 else 1.0
        moved[b] = np.sqrt(square / (size - 3)) * longer if good else 0.0
