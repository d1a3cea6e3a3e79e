"""The vector-Jacobian products of `habitus.body.kernels`, compiled: gradients of the body function
for torch tensors on the CPU (`habitus.body.gradients`).

Accumulators belong to tiles of vertices, which do not depend on the number of threads, and are
summed in order: gradients are the same bit for bit with any number of threads.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from habitus.body.kernels import (
    CHUNK,
    FEW,
    VERTICES,
    LocalShapes,
    padded,
    read_only,
    rest_of_tile,
)
from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.kernels.simd import LANES, load_at, spread, store_at
from habitus.kernels.threads import one_blas_thread, run_chunks


def posed_vertices_vjp(
    gradient: Float[np.ndarray, "b N 3"],
    kept: Float[np.ndarray, "B 3N"],
    rows: Float[np.ndarray, "K 3N"],
    motions: Float[np.ndarray, "b J 12"],
    index: Int[np.ndarray, "N I"],
    value: Float[np.ndarray, "N I"],
    local: tuple[LocalShapes, int] | None,
    with_shape: bool,
) -> tuple[
    Float[np.ndarray, "b K"] | None, Float[np.ndarray, "b F"] | None, Float[np.ndarray, "b J 12"]
]:
    """Gradients to coefficients, features of the local shapes, and motions of a function of the
    vertices that `habitus.body.kernels.posed_vertices` gives (linear blend skinning); ``gradient``
    is the one to the vertices, ``kept`` what that function filled, ``local`` its local shapes and
    the number of their features. Without ``with_shape`` the first is left out.
    """
    gradient, rows, index, value = read_only(gradient, rows, index, value)
    bodies, count = gradient.shape[:2]
    kind = gradient.dtype
    tiles = -(-count // VERTICES)
    driven = 0 if local is None else local[1]
    to_shape = np.zeros((tiles, len(rows) if with_shape else 0, bodies), kind)
    to_features = np.zeros((tiles, driven, bodies), kind)
    to_motions = np.zeros((tiles, *motions.shape[1:], bodies), kind)
    pull_back, add_shape = (
        (_one_by_one, _rows_times) if bodies <= FEW else (_many_side_by_side, _rows_times_many)
    )

    def some_tiles(_: int, begin: int, end: int) -> None:
        for tile in range(begin, end):
            first, last = tile * VERTICES, min((tile + 1) * VERTICES, count)
            for body in range(0, bodies, CHUNK):
                few = slice(body, min(body + CHUNK, bodies))
                filled = slice(body, min(body + CHUNK, len(kept)))
                rest = rest_of_tile(kept, filled, first, last)
                slopes = pull_back(
                    rest, gradient[few], motions[few], index, value, to_motions[tile][..., few],
                    local, to_features[tile, :, few], first, last,
                )  # fmt: skip
                if with_shape:
                    add_shape(rows, slopes, to_shape[tile, :, few], first, last)

    with one_blas_thread():
        run_chunks(some_tiles, tiles, least=1, pieces=2)
    return (
        to_shape.sum(0).T if with_shape else None,
        None if local is None else np.ascontiguousarray(to_features.sum(0).T),
        np.ascontiguousarray(to_motions.sum(0).transpose(2, 0, 1)),
    )


def _many_side_by_side(
    rest, gradient, motions, index, value, to_motions, local, to_features, begin, end
) -> Float[np.ndarray, "3n B"]:
    """Gradients to the rest positions begin..end of many bodies, which lie side by side and fill
    the lanes; those to motions and features are added to ``to_motions`` (J, 12, b) and
    ``to_features`` (F, b).
    """
    rest = rest.T
    bodies = len(motions)
    moves = padded(motions.transpose(1, 2, 0), rest.shape[1]).reshape(-1, rest.shape[1])
    slopes = np.zeros(rest.shape, rest.dtype)
    _read_bodies(gradient, slopes, begin, end)
    gathered = np.zeros(moves.shape, rest.dtype)
    _skin_vjp_side_by_side(rest, slopes, moves, gathered, index, value, begin, end)
    to_motions += gathered.reshape(len(to_motions), 12, -1)[..., :bodies]
    if local is not None:
        shapes = local[0]
        gathered = np.zeros((len(to_features), rest.shape[1]), rest.dtype)
        _local_vjp_side_by_side(
            slopes, gathered, shapes.start, shapes.driver, shapes.value, begin, end
        )
        to_features += gathered[:, :bodies]
    return slopes


def _one_by_one(
    rest, gradient, motions, index, value, to_motions, local, to_features, begin, end
) -> Float[np.ndarray, "3n b"]:
    """As `_many_side_by_side`, body by body."""
    slopes = np.empty(rest.shape, rest.dtype)
    gathered = np.zeros(motions.shape, rest.dtype)
    _skin_vjp(rest, gradient, motions, slopes, gathered, index, value, begin, end)
    to_motions += gathered.transpose(1, 2, 0)
    if local is not None:
        shapes = local[0]
        gathered = np.zeros(to_features.shape[::-1], rest.dtype)
        _local_vjp(slopes, gathered, shapes.start, shapes.driver, shapes.value, begin, end)
        to_features += gathered.T
    return slopes.T


def _rows_times(rows, slopes, out, begin, end) -> None:
    """Add the products of the rows' vertices begin..end and slopes (3n, b) to ``out`` (K, b)."""
    count, tile = rows.shape[1] // 3, end - begin
    for axis in range(3):
        columns = rows[:, axis * count + begin : axis * count + end]
        out += columns @ slopes[axis * tile : (axis + 1) * tile]


def _rows_times_many(rows, slopes, out, begin, end) -> None:
    """As `_rows_times`, of bodies that fill the lanes."""
    found = np.empty((len(rows), slopes.shape[1]), slopes.dtype)
    _rows_times_side_by_side(rows, slopes, found, begin, end)
    out += found[:, : out.shape[1]]


@jit_noalloc
def _rows_times_side_by_side(rows, slopes, out, begin, end):
    """Eight rows at a time, whose sums stay in registers while all vertices are read."""
    tile = end - begin
    count = rows.shape[1] // 3
    for s in range(0, slopes.shape[1], LANES * 8 // slopes.itemsize):
        for k in range(0, len(rows) - len(rows) % 8, 8):
            zero = spread(slopes, 0.0)
            sums = (zero, zero, zero, zero, zero, zero, zero, zero)
            for axis in range(3):
                for i in range(tile):
                    column = axis * count + begin + i
                    x = load_at(slopes, axis * tile + i, s)
                    sums = (
                        sums[0] + x * rows[k, column], sums[1] + x * rows[k + 1, column],
                        sums[2] + x * rows[k + 2, column], sums[3] + x * rows[k + 3, column],
                        sums[4] + x * rows[k + 4, column], sums[5] + x * rows[k + 5, column],
                        sums[6] + x * rows[k + 6, column], sums[7] + x * rows[k + 7, column],
                    )  # fmt: skip
            for e in range(8):
                store_at(out, k + e, s, sums[e])
        for k in range(len(rows) - len(rows) % 8, len(rows)):
            total = spread(slopes, 0.0)
            for axis in range(3):
                for i in range(tile):
                    x = load_at(slopes, axis * tile + i, s)
                    total = total + x * rows[k, axis * count + begin + i]
            store_at(out, k, s, total)


@jit_noalloc
def _read_bodies(gradient, slopes, begin, end):
    """Rows x, y, z of the vertices begin..end, with the bodies side by side."""
    tile = end - begin
    for first in range(0, len(gradient), 16):
        for i in range(tile):
            for s in range(first, min(first + 16, len(gradient))):
                slopes[i, s] = gradient[s, begin + i, 0]
                slopes[i + tile, s] = gradient[s, begin + i, 1]
                slopes[i + 2 * tile, s] = gradient[s, begin + i, 2]


@jit_noalloc
def _skin_vjp_side_by_side(rest, slopes, moves, gathered, index, value, begin, end):
    """``slopes`` holds gradients to posed vertices, then those to vertices at rest; ``moves`` and
    ``gathered`` have 12 rows a joint.
    """
    tile = end - begin
    for i in range(begin, end):
        row = i - begin
        for s in range(0, rest.shape[1], LANES * 8 // rest.itemsize):
            x = load_at(rest, row, s)
            y = load_at(rest, row + tile, s)
            z = load_at(rest, row + 2 * tile, s)
            a = load_at(slopes, row, s)
            b = load_at(slopes, row + tile, s)
            c = load_at(slopes, row + 2 * tile, s)
            u = spread(rest, 0.0)
            v = spread(rest, 0.0)
            w = spread(rest, 0.0)
            for k in range(index.shape[1]):
                share = value[i, k]
                if share != 0.0:
                    m = 12 * index[i, k]
                    p = a * share
                    q = b * share
                    r = c * share
                    u = u + load_at(moves, m, s) * p + load_at(moves, m + 4, s) * q
                    u = u + load_at(moves, m + 8, s) * r
                    v = v + load_at(moves, m + 1, s) * p + load_at(moves, m + 5, s) * q
                    v = v + load_at(moves, m + 9, s) * r
                    w = w + load_at(moves, m + 2, s) * p + load_at(moves, m + 6, s) * q
                    w = w + load_at(moves, m + 10, s) * r
                    _add_outer(gathered, m, s, p, x, y, z)
                    _add_outer(gathered, m + 4, s, q, x, y, z)
                    _add_outer(gathered, m + 8, s, r, x, y, z)
            store_at(slopes, row, s, u)
            store_at(slopes, row + tile, s, v)
            store_at(slopes, row + 2 * tile, s, w)


@jit_inline
def _add_outer(gathered, row, s, p, x, y, z):
    """Add p (x, y, z, 1) to four rows."""
    store_at(gathered, row, s, load_at(gathered, row, s) + p * x)
    store_at(gathered, row + 1, s, load_at(gathered, row + 1, s) + p * y)
    store_at(gathered, row + 2, s, load_at(gathered, row + 2, s) + p * z)
    store_at(gathered, row + 3, s, load_at(gathered, row + 3, s) + p)


@jit_noalloc
def _skin_vjp(rest, gradient, motions, slopes, gathered, index, value, begin, end):
    tile = end - begin
    for s in range(len(rest)):
        for i in range(begin, end):
            x = rest[s, i - begin]
            y = rest[s, i - begin + tile]
            z = rest[s, i - begin + 2 * tile]
            a = gradient[s, i, 0]
            b = gradient[s, i, 1]
            c = gradient[s, i, 2]
            u = v = w = a * 0.0
            for k in range(index.shape[1]):
                share = value[i, k]
                if share == 0.0:
                    continue
                m = motions[s, index[i, k]]
                g = gathered[s, index[i, k]]
                p = share * a
                q = share * b
                r = share * c
                u += m[0] * p + m[4] * q + m[8] * r
                v += m[1] * p + m[5] * q + m[9] * r
                w += m[2] * p + m[6] * q + m[10] * r
                g[0] += p * x
                g[1] += p * y
                g[2] += p * z
                g[3] += p
                g[4] += q * x
                g[5] += q * y
                g[6] += q * z
                g[7] += q
                g[8] += r * x
                g[9] += r * y
                g[10] += r * z
                g[11] += r
            slopes[s, i - begin] = u
            slopes[s, i - begin + tile] = v
            slopes[s, i - begin + 2 * tile] = w


@jit_noalloc
def _local_vjp_side_by_side(slopes, gathered, start, driver, value, begin, end):
    """Gradients to the features of local blend shapes."""
    tile = end - begin
    for i in range(begin, end):
        row = i - begin
        for s in range(0, slopes.shape[1], LANES * 8 // slopes.itemsize):
            u = load_at(slopes, row, s)
            v = load_at(slopes, row + tile, s)
            w = load_at(slopes, row + 2 * tile, s)
            for g in range(start[i], start[i + 1]):
                shape = value[g]
                for e in range(9):
                    to = 9 * driver[g] + e
                    own = u * shape[3 * e] + v * shape[3 * e + 1] + w * shape[3 * e + 2]
                    store_at(gathered, to, s, load_at(gathered, to, s) + own)


@jit_noalloc
def _local_vjp(slopes, gathered, start, driver, value, begin, end):
    tile = end - begin
    for s in range(len(slopes)):
        for i in range(begin, end):
            u = slopes[s, i - begin]
            v = slopes[s, i - begin + tile]
            w = slopes[s, i - begin + 2 * tile]
            for g in range(start[i], start[i + 1]):
                first = 9 * driver[g]
                row = value[g]
                for e in range(9):
                    gathered[s, first + e] += (
                        row[3 * e] * u + row[3 * e + 1] * v + row[3 * e + 2] * w
                    )


def joint_motions_vjp(
    pose: Float[np.ndarray, "b J 3"],
    rest_joints: Float[np.ndarray, "b J 3"],
    parents: Int[np.ndarray, " J"],
    motions: Float[np.ndarray, "b J 12"],
    to_motions: Float[np.ndarray, "b J 12"],
    to_posed: Float[np.ndarray, "b J 3"],
    to_entries: Float[np.ndarray, "b J 9"],
) -> tuple[Float[np.ndarray, "b J 3"], Float[np.ndarray, "b J 3"]]:
    """Gradients to pose and rest joints from those to the three results of
    `habitus.body.kernels.joint_motions`; computed in float64, given in the type of ``pose``.
    """
    given = (pose, rest_joints, parents, motions)
    pose, rest_joints, parents, motions = read_only(*given)
    slopes = to_motions.astype(np.float64)
    places = to_posed.astype(np.float64)
    entries = to_entries.astype(np.float64)
    to_pose = np.empty(pose.shape)
    to_rest = np.zeros(pose.shape)
    _joint_motions_vjp(
        pose.astype(np.float64), rest_joints.astype(np.float64), parents,
        motions.astype(np.float64), slopes, places, entries, to_pose, to_rest,
    )  # fmt: skip
    return to_pose.astype(pose.dtype), to_rest.astype(pose.dtype)


@jit_noalloc
def _joint_motions_vjp(pose, rest, parents, motions, slopes, places, entries, to_pose, to_rest):
    """``slopes`` and ``places`` collect what the joints below add; the tips come first."""
    for s in range(len(pose)):
        for j in range(pose.shape[1] - 1, -1, -1):
            joint = rest[s, j]
            own = slopes[s, j]
            place = places[s, j]
            turn = motions[s, j]
            for c in range(3):
                # the motion's translation is the posed joint less the turned rest joint
                place[c] += own[4 * c + 3]
                for r in range(3):
                    to_rest[s, j, r] -= turn[4 * c + r] * own[4 * c + 3]
                    own[4 * c + r] -= own[4 * c + 3] * joint[r]
            if parents[j] < 0:
                for c in range(3):
                    to_rest[s, j, c] += place[c]
                    for r in range(3):
                        entries[s, j, 3 * c + r] += own[4 * c + r]
            else:
                _to_parent(
                    motions[s, parents[j]], turn, joint, own, place,
                    slopes[s, parents[j]], entries[s, j], to_rest[s, j],
                )  # fmt: skip
            _rodrigues_vjp(pose[s, j], entries[s, j], to_pose[s, j])


@jit_inline
def _to_parent(above, turn, joint, own, place, slopes, entries, to_rest):
    """Through W = A R and p = A j + t, where A and t are the parent's rotation and translation."""
    for r in range(3):
        for c in range(3):
            # (A' G) of the joint's own rotation; G R' of the parent's, with R = A' W
            entries[3 * r + c] += (
                above[r] * own[c] + above[4 + r] * own[4 + c] + above[8 + r] * own[8 + c]
            )
            turned = 0.0
            for e in range(3):
                rotation = (
                    above[c] * turn[e] + above[4 + c] * turn[4 + e] + above[8 + c] * turn[8 + e]
                )
                turned += own[4 * r + e] * rotation
            slopes[4 * r + c] += turned + place[r] * joint[c]
        slopes[4 * r + 3] += place[r]
        to_rest[r] += above[r] * place[0] + above[4 + r] * place[1] + above[8 + r] * place[2]


@jit_inline
def _rodrigues_vjp(vector, g, out):
    """Through R - I = a [x] + b (x x' - |x|^2 I), with a = sin t / t, b = (1 - cos t) / t^2."""
    x, y, z = vector
    squared = x * x + y * y + z * z
    if squared < 0.01:
        a = 1.0 - squared / 6.0 * (1.0 - squared / 20.0 * (1.0 - squared / 42.0))
        b = 0.5 - squared / 24.0 * (1.0 - squared / 30.0 * (1.0 - squared / 56.0))
        da = -1.0 / 3.0 + squared / 30.0 * (1.0 - squared / 28.0 * (1.0 - squared / 54.0))
        db = -1.0 / 12.0 + squared / 180.0 * (1.0 - squared / 37.333333333333336)
    else:
        angle = math.sqrt(squared)
        half = math.sin(0.5 * angle)
        a = math.sin(angle) / angle
        b = 2.0 * half * half / squared
        da = (math.cos(angle) - a) / squared
        db = (a - 2.0 * b) / squared
    trace = g[0] + g[4] + g[8]
    p = g[7] - g[5]
    q = g[2] - g[6]
    r = g[3] - g[1]
    gx = g[0] * x + g[1] * y + g[2] * z
    gy = g[3] * x + g[4] * y + g[5] * z
    gz = g[6] * x + g[7] * y + g[8] * z
    tx = g[0] * x + g[3] * y + g[6] * z
    ty = g[1] * x + g[4] * y + g[7] * z
    tz = g[2] * x + g[5] * y + g[8] * z
    along = da * (p * x + q * y + r * z) + db * (x * gx + y * gy + z * gz - squared * trace)
    out[0] = a * p + b * (gx + tx - 2.0 * trace * x) + along * x
    out[1] = a * q + b * (gy + ty - 2.0 * trace * y) + along * y
    out[2] = a * r + b * (gz + tz - 2.0 * trace * z) + along * z
