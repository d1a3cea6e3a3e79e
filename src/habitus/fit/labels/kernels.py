"""The inner loops of labelling, compiled: links between frames, soft and firm matches of points and
markers.

Points of all frames lie behind each other; those of frame t are start[t] : start[t + 1].
"""

import numpy as np

from habitus.kernels.jit import jit


@jit
def link(points, start, gate, first_gate, longest_gap, clearly):
    """The tracklet of each point (P,): its prediction and it are nearest to each other, and nothing
    else is as near.

    gate: how far (m) a point may be from where its tracklet's last motion leads, first_gate where
    it has none of its own yet; longest_gap: frames that a tracklet may miss; clearly: how many
    times further the next candidate must be.
    """
    tracklet = np.full(len(points), -1)
    place = np.empty((len(points), 3))
    speed = np.zeros((len(points), 3))
    last = np.full(len(points), -1)
    length = np.zeros(len(points), np.int64)
    active = np.empty(2 * len(points), np.int64)
    count = 0
    number = 0
    for t in range(len(start) - 1):
        count = _still_active(active, count, last, t - longest_gap - 1)
        frame = points[start[t] : start[t + 1]]
        taken = tracklet[start[t] : start[t + 1]]
        reach = np.empty(count)
        for a in range(count):
            k = active[a]
            reach[a] = (gate if length[k] > 1 else first_gate) * (t - last[k])
        distance = _from_predictions(place, speed, last, active[:count], t, frame, 2.0 * reach)
        for j in range(len(frame)):
            a = _clear_choice(distance, j, clearly)
            if a >= 0 and distance[a, j] <= reach[a]:
                taken[j] = active[a]
        for j in range(len(frame)):
            if taken[j] < 0:
                near = distance[:, j].min() if count else np.inf
                for a in range(count):
                    if distance[a, j] < clearly * near:
                        _end(taken, active[a], last)
        for j in range(len(frame)):
            k = taken[j]
            if k >= 0:
                speed[k] = (frame[j] - place[k]) / (t - last[k])
                place[k], last[k] = frame[j], t
                length[k] += 1
        for j in range(len(frame)):
            if taken[j] < 0:
                taken[j], place[number], last[number], length[number] = number, frame[j], t, 1
                _neighbour_speed(place, speed, last, length, active[:count], number, t)
                active[count] = number
                count += 1
                number += 1
    return tracklet


@jit
def _still_active(active, count, last, earliest):
    """How many of the first ``count`` tracklets were seen at ``earliest`` or later; these move to
    the front.
    """
    kept = 0
    for a in range(count):
        if last[active[a]] >= 0 and last[active[a]] >= earliest:
            active[kept] = active[a]
            kept += 1
    return kept


@jit
def _from_predictions(place, speed, last, active, t, points, limit):
    """(A, N) distances of a frame's points from where tracklets are expected in it; infinite beyond
    each one's limit.
    """
    distance = np.empty((len(active), len(points)))
    for a in range(len(active)):
        k = active[a]
        ahead = t - last[k]
        for j in range(len(points)):
            total = 0.0
            for c in range(3):
                off = place[k, c] + ahead * speed[k, c] - points[j, c]
                total += off * off
            length = np.sqrt(total)
            distance[a, j] = length if length < limit[a] else np.inf
    return distance


@jit
def _neighbour_speed(place, speed, last, length, active, number, t):
    """Give a tracklet that begins in frame t the speed of the nearest one within 40 cm that was
    seen in it and moves by a speed of its own.
    """
    near = 0.4
    for other in active:
        if last[other] == t and length[other] > 2:
            off = np.sqrt(np.sum((place[other] - place[number]) ** 2))
            if off < near:
                near = off
                speed[number] = speed[other]


@jit
def _clear_choice(distance, j, clearly):
    """The row that is nearest to column j where no other row, and to it no other column, is nearly
    as near; or -1.
    """
    best = np.inf
    second = np.inf
    chosen = -1
    for a in range(len(distance)):
        if distance[a, j] < best:
            best, second, chosen = distance[a, j], best, a
        elif distance[a, j] < second:
            second = distance[a, j]
    if chosen < 0 or second < clearly * max(best, 1e-3):
        return -1
    for i in range(distance.shape[1]):
        if i != j and distance[chosen, i] < clearly * max(best, 1e-3):
            return -1
    return chosen


@jit
def _end(taken, k, last):
    """No point joins tracklet k any more, unless one of this frame did."""
    for other in taken:
        if other == k:
            return
    last[k] = -1


@jit
def soft_targets(predicted, points, start, frames, spread, beyond, targets, weights):
    """For each state h, of frame frames[h]: where the points that each marker explains lie in the
    mean, and how many.

    A point is shared among the markers by exp(-d^2 / 2 spread^2), with ``beyond`` for none of them.
    """
    scale = -0.5 / (spread * spread)
    for h in range(len(predicted)):
        markers = predicted.shape[1]
        share = np.empty(markers)
        for i in range(markers):
            weights[h, i] = 0.0
            for c in range(3):
                targets[h, i, c] = 0.0
        for j in range(start[frames[h]], start[frames[h] + 1]):
            total = beyond
            for i in range(markers):
                squared = 0.0
                for c in range(3):
                    off = predicted[h, i, c] - points[j, c]
                    squared += off * off
                share[i] = np.exp(squared * scale)
                total += share[i]
            for i in range(markers):
                part = share[i] / total
                if part > 1e-4:
                    weights[h, i] += part
                    for c in range(3):
                        targets[h, i, c] += part * points[j, c]
        for i in range(markers):
            if weights[h, i] > 1e-6:
                for c in range(3):
                    targets[h, i, c] /= weights[h, i]
                weights[h, i] = min(weights[h, i], 1.0)
            else:
                weights[h, i] = 0.0


@jit
def hungarian(cost, row_of):
    """The cheapest match of n rows to m >= n columns; row_of (m,) receives the row of each column
    or -1.

    The shortest augmenting paths of Jonker and Volgenant, as in Kuhn's method with potentials.
    """
    n, m = cost.shape
    u = np.zeros(n + 1)
    v = np.zeros(m + 1)
    match = np.full(m + 1, -1)
    way = np.zeros(m + 1, np.int64)
    for row in range(n):
        match[m] = row
        column = m
        least = np.full(m, np.inf)
        used = np.zeros(m + 1, np.bool_)
        while match[column] >= 0:
            used[column] = True
            i = match[column]
            delta = np.inf
            following = 0
            for j in range(m):
                if not used[j]:
                    reduced = cost[i, j] - u[i] - v[j]
                    if reduced < least[j]:
                        least[j], way[j] = reduced, column
                    if least[j] < delta:
                        delta = least[j]
                        following = j
            for j in range(m + 1):
                if used[j]:
                    u[match[j]] += delta
                    v[j] -= delta
                elif j < m:
                    least[j] -= delta
            column = following
        while column != m:
            match[column] = match[way[column]]
            column = way[column]
    row_of[:] = match[:m]


@jit
def matched(cost, gate, out):
    """Match rows (markers) to columns (points) below a gate; out (rows,) receives the column or -1.
    The total cost: unmatched ones of the scarcer side cost the gate.
    """
    rows, columns = cost.shape
    clipped = np.minimum(cost, gate)
    out[:] = -1
    if rows == 0 or columns == 0:
        return 0.0
    total = 0.0
    if rows <= columns:
        row_of = np.empty(columns, np.int64)
        hungarian(clipped, row_of)
        for j in range(columns):
            if row_of[j] >= 0:
                total += clipped[row_of[j], j]
                if cost[row_of[j], j] < gate:
                    out[row_of[j]] = j
    else:
        column_of = np.empty(rows, np.int64)
        hungarian(np.ascontiguousarray(clipped.T), column_of)
        for i in range(rows):
            if column_of[i] >= 0:
                total += clipped[i, column_of[i]]
                if cost[i, column_of[i]] < gate:
                    out[i] = column_of[i]
    return total


@jit
def firm_matches(predicted, points, start, frames, gate, match, cost):
    """For each state the point (index into points) of each marker, -1 for none, and the total of
    squared distances, cut at gate^2.
    """
    for h in range(len(predicted)):
        first = start[frames[h]]
        size = start[frames[h] + 1] - start[frames[h]]
        squared = np.empty((predicted.shape[1], size))
        for i in range(predicted.shape[1]):
            for j in range(size):
                total = 0.0
                for c in range(3):
                    off = predicted[h, i, c] - points[first + j, c]
                    total += off * off
                squared[i, j] = total
        cost[h] = matched(squared, gate * gate, match[h])
        for i in range(predicted.shape[1]):
            if match[h, i] >= 0:
                match[h, i] += first


@jit
def assign_frames(costs, start, gates, label):
    """Frame by frame the cheapest match of points (rows of costs (P, M)) to markers; label (P,)
    receives it or -1.

    gates (P,) is what leaving a point without a label costs.
    """
    for t in range(len(start) - 1):
        first = start[t]
        size = start[t + 1] - start[t]
        if size == 0:
            continue
        markers = costs.shape[1]
        padded = np.empty((size, markers + size))
        for j in range(size):
            for i in range(markers):
                padded[j, i] = costs[first + j, i]
            for i in range(size):
                padded[j, markers + i] = gates[first + j]
        row_of = np.empty(markers + size, np.int64)
        hungarian(padded, row_of)
        for j in range(size):
            label[first + j] = -1
        for i in range(markers):
            if row_of[i] >= 0:
                label[first + row_of[i]] = i


@jit
def squared_distances(points, start, predicted, limit, out):
    """Squared distance (P, M) of each point from each predicted marker (T, M, 3) of its frame, at
    most ``limit``.
    """
    for t in range(len(start) - 1):
        for j in range(start[t], start[t + 1]):
            for i in range(predicted.shape[1]):
                total = 0.0
                for c in range(3):
                    off = predicted[t, i, c] - points[j, c]
                    total += off * off
                out[j, i] = min(total, limit)
