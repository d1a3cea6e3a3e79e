"""The body function compiled: for NumPy arrays, and torch tensors on the CPU that want no gradient
(S 3, eqs. 1 to 11).

The readable form of the same is `PreparedBody` (`prepared.py`) and `skinning.py`; tests hold the
two together. Pose blend shapes of which most are zero (S 5.2) are kept as `LocalShapes`: for each
vertex those of the few joints that drive it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.dual_kernels import dual_quaternions, skin_dual
from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.kernels.simd import LANES, load_at, num_lanes, spread, store_at
from habitus.kernels.threads import run_chunks

PER_JOINT = 9
"""Features of a joint: the entries of R - I."""
SPARSE = 0.5
"""Up to this share of joints and vertices that have to do with each other it pays to leave the
others out.
"""
LEAST = 256
"""Fewer vertices are not worth it."""


@dataclass(frozen=True, eq=False)
class LocalShapes:
    """The joints that drive vertex i are ``driver[start[i] : start[i + 1]]``; each moves it by
    ``value`` (m), nine features after each other, times their x, y and z. ``driver`` counts those
    of the body's `drivers`.
    """

    start: Int[np.ndarray, " N1"]
    driver: Int[np.ndarray, " G"]
    value: Float[np.ndarray, "G 27"]

    def add(
        self,
        rest: Float[np.ndarray, "b 3n"],
        features: Float[np.ndarray, "b F"],
        begin: int,
        end: int,
        *,
        side_by_side: bool,
    ) -> None:
        """Add what the features of b bodies move the vertices begin..end by; ``side_by_side``: of
        rest.T's memory, with as many bodies as fill the lanes (`full_lanes`).
        """
        if side_by_side:
            lines = padded(features.T, rest.shape[0])
            _add_side_by_side(rest.T, lines, self.start, self.driver, self.value, begin, end)
        else:
            _add(rest, features, self.start, self.driver, self.value, begin, end)


def local_shapes(
    posedirs: Float[np.ndarray, "N 3 F"] | None, per_joint: int, blocks: int
) -> LocalShapes | None:
    """The same blend shapes without the zeros; None where it does not pay: few vertices, few zeros,
    other features.

    ``blocks`` is how many times the features are there: once, and once for each shape coefficient
    they depend on.
    """
    if posedirs is None or per_joint != PER_JOINT or blocks != 1 or len(posedirs) < LEAST:
        return None
    shapes = without_zeros(posedirs)
    return None if len(shapes.driver) > SPARSE * posedirs.size / (3 * PER_JOINT) else shapes


def without_zeros(posedirs: Float[np.ndarray, "N 3 F"]) -> LocalShapes:
    """Blend shapes driven by entries of R - I, or hinges, nine by nine, however few their zeros."""
    by_joint = posedirs.reshape(len(posedirs), 3, -1, PER_JOINT)
    drives = by_joint.any((1, 3))
    vertex, driver = np.nonzero(drives)
    start = np.concatenate([[0], np.cumsum(drives.sum(1))])
    value = by_joint[vertex, :, driver].transpose(0, 2, 1).reshape(-1, 3 * PER_JOINT)
    return LocalShapes(start.astype(np.int64), driver.astype(np.int64), np.ascontiguousarray(value))


@jit_noalloc
def _add(rest, features, start, driver, value, begin, end):
    """Body by body."""
    tile = end - begin
    for s in range(len(rest)):
        for i in range(begin, end):
            x = y = z = rest[s, i - begin] * 0.0
            for g in range(start[i], start[i + 1]):
                first = 9 * driver[g]
                row = value[g]
                for e in range(9):
                    f = features[s, first + e]
                    x += row[3 * e] * f
                    y += row[3 * e + 1] * f
                    z += row[3 * e + 2] * f
            rest[s, i - begin] += x
            rest[s, i - begin + tile] += y
            rest[s, i - begin + 2 * tile] += z


@jit_noalloc
def _add_side_by_side(rest, features, start, driver, value, begin, end):
    """Vertex by vertex, as many bodies at once as there are lanes."""
    tile = end - begin
    for i in range(begin, end):
        row = i - begin
        for s in range(0, rest.shape[1], LANES * 8 // rest.itemsize):
            x = load_at(rest, row, s)
            y = load_at(rest, row + tile, s)
            z = load_at(rest, row + 2 * tile, s)
            for g in range(start[i], start[i + 1]):
                shape = value[g]
                for e in range(9):
                    f = load_at(features, 9 * driver[g] + e, s)
                    x = x + f * shape[3 * e]
                    y = y + f * shape[3 * e + 1]
                    z = z + f * shape[3 * e + 2]
            store_at(rest, row, s, x)
            store_at(rest, row + tile, s, y)
            store_at(rest, row + 2 * tile, s, z)


FEW = 3
"""Up to so many bodies at once, blend shapes are added row by row, those of no weight left out."""
CHUNK = 64
"""Bodies of a chunk: their surfaces and motions stay in a core's own cache."""
VERTICES = 512
"""Vertices of a tile, whose rest positions stay in a core's own cache. Tiles do not depend on the
number of threads, so that vertices are the same bit for bit with any.
"""
STREAMS = 16
"""Bodies whose vertices are written side by side."""


def joint_motions(
    pose: Float[np.ndarray, "b J 3"],
    rest_joints: Float[np.ndarray, "s J 3"],
    parents: Int[np.ndarray, " J"],
) -> tuple[Float[np.ndarray, "b J 12"], Float[np.ndarray, "b J 3"], Float[np.ndarray, "b J9"]]:
    """Skinning motions [R | p - R J] row by row, posed joints (m), and vec(R - I) of the joints'
    own rotations.

    ``rest_joints`` are of one body (s = 1) or of each.
    """
    pose, rest_joints, parents = read_only(pose, rest_joints, parents)
    bodies, joints = pose.shape[:2]
    motions = np.empty((bodies, joints, 12), pose.dtype)
    posed = np.empty((bodies, joints, 3), pose.dtype)
    features = np.empty((bodies, joints, 9), pose.dtype)
    _joint_motions(pose, rest_joints, parents, motions, posed, features)
    return motions, posed, features.reshape(bodies, 9 * joints)


def posed_vertices(
    base: Float[np.ndarray, " 3N"],
    coefficients: Float[np.ndarray, "b K"],
    rows: Float[np.ndarray, "K 3N"],
    motions: Float[np.ndarray, "b J 12"],
    trans: Float[np.ndarray, "b 3"],
    index: Int[np.ndarray, "N I"],
    value: Float[np.ndarray, "N I"],
    skinning: str,
    local: tuple[LocalShapes, Float[np.ndarray, "b F"]] | None = None,
    kept: Float[np.ndarray, "B 3N"] | None = None,
) -> Float[np.ndarray, "b N 3"]:
    """Vertices (m) of b bodies: blend shapes added to a surface at rest that all share, skinned,
    moved.

    Surfaces are rows of x, then y, then z. All floating arrays have one dtype and are contiguous.
    ``local``: further blend shapes and the features that drive them. ``kept``: memory for the
    surfaces at rest, B = `rows_kept` rows, which `habitus.body.kernels_vjp` needs
    (`rest_of_tile` finds them there).
    """
    base, coefficients, rows, trans, index, value = read_only(
        base, coefficients, rows, trans, index, value
    )
    bodies = len(motions)
    count = len(index)
    out = np.empty((bodies, count, 3), motions.dtype)
    carriers, (add, skin) = (
        motions,
        (_add_rows, _skin_linear) if bodies <= FEW else (_add_products, _skin_linear_many),
    )
    if skinning == "dqbs":
        carriers = np.empty((*motions.shape[:2], 8), motions.dtype)
        skin = skin_dual
        dual_quaternions(motions, carriers)

    def some_tiles(_: int, begin: int, end: int) -> None:
        most = full_lanes(min(bodies, CHUNK), out.dtype)
        room = np.empty(most * 3 * min(VERTICES, count), out.dtype)
        for first in range(begin * VERTICES, min(end * VERTICES, count), VERTICES):
            last = min(first + VERTICES, count)
            for body in range(0, bodies, CHUNK):
                few = slice(body, min(body + CHUNK, bodies))
                rest = add(base, coefficients[few], rows, room, first, last)
                if local is not None:
                    local[0].add(rest, local[1][few], first, last, side_by_side=bodies > FEW)
                if kept is not None:
                    rest_of_tile(kept, slice(body, body + len(rest)), first, last)[:] = rest
                skin(rest, carriers[few], trans[few], index, value, out[few], first, last)

    run_chunks(some_tiles, -(-count // VERTICES), least=2, pieces=2)
    return out


def full_lanes(bodies: int, dtype: np.dtype) -> int:
    """The number of bodies, rounded up to a multiple of the lanes."""
    lanes = num_lanes(dtype)
    return -(-bodies // lanes) * lanes


def rows_kept(bodies: int, dtype: np.dtype) -> int:
    """Rows of ``kept`` of `posed_vertices`: `full_lanes` of more than `FEW` bodies."""
    return bodies if bodies <= FEW else full_lanes(bodies, dtype)


def padded(columns: np.ndarray, width: int) -> np.ndarray:
    """Columns (..., b) with columns of zeros appended up to ``width``, in C order."""
    out = np.zeros((*columns.shape[:-1], width), columns.dtype)
    out[..., : columns.shape[-1]] = columns
    return out


def rest_of_tile(
    kept: Float[np.ndarray, "B 3N"], few: slice, first: int, last: int
) -> Float[np.ndarray, "c 3n"]:
    """Where the vertices first..last of some bodies lie at rest, in one piece of ``kept``; many
    bodies lie side by side.
    """
    count = len(kept[few])
    rows = kept[few].reshape(-1)[3 * first * count : 3 * last * count]
    return rows.reshape(count, -1) if len(kept) <= FEW else rows.reshape(-1, count).T


def _add_rows(base, coefficients, rows, room, begin: int, end: int) -> Float[np.ndarray, "b 3n"]:
    """Surfaces at rest of the vertices begin..end, in ``room``; rows of no weight cost nothing."""
    rest = room[: len(coefficients) * 3 * (end - begin)].reshape(len(coefficients), -1)
    _add_row_runs(base, coefficients, rows, rest, begin, end)
    return rest


def _add_products(
    base, coefficients, rows, room, begin: int, end: int
) -> Float[np.ndarray, "b 3n"]:
    """As `_add_rows`; bodies lie side by side, as many as fill the lanes."""
    width = full_lanes(len(coefficients), rows.dtype)
    rest = room[: width * 3 * (end - begin)].reshape(-1, width)
    _add_products_side_by_side(base, padded(coefficients.T, width), rows, rest, begin, end)
    return rest.T


@jit_noalloc
def _add_products_side_by_side(base, weights, rows, rest, begin, end):
    """Eight coordinates at a time, whose sums stay in registers while all rows are read."""
    tile = end - begin
    for axis in range(3):
        first = axis * (len(base) // 3) + begin
        for i in range(0, tile - tile % 8, 8):
            for s in range(0, rest.shape[1], LANES * 8 // rest.itemsize):
                sums = spread8(rest, base, first + i)
                for k in range(len(rows)):
                    sums = plus8(sums, load_at(weights, k, s), rows[k], first + i)
                for e in range(8):
                    store_at(rest, axis * tile + i + e, s, sums[e])
        for i in range(tile - tile % 8, tile):
            for s in range(0, rest.shape[1], LANES * 8 // rest.itemsize):
                total = spread(rest, base[first + i])
                for k in range(len(rows)):
                    total = total + load_at(weights, k, s) * rows[k, first + i]
                store_at(rest, axis * tile + i, s, total)


@jit_inline
def spread8(rest, numbers, first):
    """Eight numbers, each in every lane."""
    return (
        spread(rest, numbers[first]), spread(rest, numbers[first + 1]),
        spread(rest, numbers[first + 2]), spread(rest, numbers[first + 3]),
        spread(rest, numbers[first + 4]), spread(rest, numbers[first + 5]),
        spread(rest, numbers[first + 6]), spread(rest, numbers[first + 7]),
    )  # fmt: skip


@jit_inline
def plus8(sums, x, numbers, first):
    """Eight sums, plus x times a number each."""
    return (
        sums[0] + x * numbers[first], sums[1] + x * numbers[first + 1],
        sums[2] + x * numbers[first + 2], sums[3] + x * numbers[first + 3],
        sums[4] + x * numbers[first + 4], sums[5] + x * numbers[first + 5],
        sums[6] + x * numbers[first + 6], sums[7] + x * numbers[first + 7],
    )  # fmt: skip


def read_only(*arrays: np.ndarray) -> Iterator[np.ndarray]:
    """Contiguous views that are not written: one kernel is compiled for a model's and a caller's
    arrays.
    """
    for array in arrays:
        view = np.ascontiguousarray(array).view()
        view.flags.writeable = False
        yield view


@jit_noalloc
def _joint_motions(pose, rest_joints, parents, motions, posed, features):
    for s in range(len(pose)):
        rest = rest_joints[s if len(rest_joints) > 1 else 0]
        for j in range(pose.shape[1]):
            _rodrigues(pose[s, j], features[s, j])
            _chain(parents[j], j, features[s, j], rest, motions[s], posed[s])


@jit_inline
def _rodrigues(vector, entries):
    """vec(R - I) of a rotation vector, without cancellation near zero."""
    x, y, z = vector
    squared = x * x + y * y + z * z
    if squared < 1e-8:
        sine = 1.0 - squared / 6.0
        versine = 0.5 - squared / 24.0
    else:
        angle = math.sqrt(squared)
        half = math.sin(0.5 * angle)
        sine = math.sin(angle) / angle
        versine = 2.0 * half * half / squared
    bx = versine * x
    by = versine * y
    bz = versine * z
    entries[0], entries[1], entries[2] = -by * y - bz * z, bx * y - sine * z, bx * z + sine * y
    entries[3], entries[4], entries[5] = bx * y + sine * z, -bx * x - bz * z, by * z - sine * x
    entries[6], entries[7], entries[8] = bx * z - sine * y, by * z + sine * x, -bx * x - by * y


@jit_inline
def _chain(parent, j, entries, rest, motions, posed):
    """Hang joint j on its parent: its posed place, and its motion (eqs. 3 and 4)."""
    m = motions[j]
    if parent < 0:
        for c in range(3):
            for r in range(3):
                m[4 * c + r] = entries[3 * c + r] + (1.0 if c == r else 0.0)
            posed[j, c] = rest[j, c]
    else:
        above = motions[parent]
        for c in range(3):
            a = above[4 * c]
            b = above[4 * c + 1]
            d = above[4 * c + 2]
            m[4 * c] = a * entries[0] + b * entries[3] + d * entries[6] + a
            m[4 * c + 1] = a * entries[1] + b * entries[4] + d * entries[7] + b
            m[4 * c + 2] = a * entries[2] + b * entries[5] + d * entries[8] + d
            posed[j, c] = a * rest[j, 0] + b * rest[j, 1] + d * rest[j, 2] + above[4 * c + 3]
    for c in range(3):
        turned = m[4 * c] * rest[j, 0] + m[4 * c + 1] * rest[j, 1] + m[4 * c + 2] * rest[j, 2]
        m[4 * c + 3] = posed[j, c] - turned


@jit_noalloc
def _add_row_runs(base, coefficients, rows, out, begin, end):
    """Four rows at a time, for all bodies while they are in the fastest cache."""
    count = len(base) // 3
    tile = end - begin
    for axis in range(3):
        first = axis * count + begin
        last = axis * count + end
        for s in range(len(out)):
            for i in range(tile):
                out[s, axis * tile + i] = base[first + i]
        for k in range(0, len(rows), 4):
            for s in range(len(out)):
                run = out[s, axis * tile : (axis + 1) * tile]
                _add_four_rows(coefficients[s, k : k + 4], rows[k : k + 4, first:last], run)


@jit_inline
def _add_four_rows(weights, rows, out):
    if len(weights) == 4:
        a = weights[0]
        b = weights[1]
        c = weights[2]
        d = weights[3]
        if a != 0.0 or b != 0.0 or c != 0.0 or d != 0.0:
            for i in range(len(out)):
                out[i] += a * rows[0, i] + b * rows[1, i] + c * rows[2, i] + d * rows[3, i]
        return
    for k in range(len(weights)):
        for i in range(len(out)):
            out[i] += weights[k] * rows[k, i]


@jit_noalloc
def _skin_linear(rest, motions, trans, index, value, out, begin, end):
    """Linear blend skinning (eq. 2) of the vertices begin..end, body by body."""
    tile = end - begin
    for s in range(len(out)):
        moves = motions[s]
        t = trans[s]
        for i in range(begin, end):
            x = rest[s, i - begin]
            y = rest[s, i - begin + tile]
            z = rest[s, i - begin + 2 * tile]
            u = t[0]
            v = t[1]
            w = t[2]
            for k in range(index.shape[1]):
                share = value[i, k]
                m = moves[index[i, k]]
                u += share * (m[0] * x + m[1] * y + m[2] * z + m[3])
                v += share * (m[4] * x + m[5] * y + m[6] * z + m[7])
                w += share * (m[8] * x + m[9] * y + m[10] * z + m[11])
            out[s, i, 0], out[s, i, 1], out[s, i, 2] = u, v, w


def _skin_linear_many(rest, motions, trans, index, value, out, begin: int, end: int) -> None:
    """As `_skin_linear`, vertex by vertex with the bodies side by side; ``rest`` is overwritten."""
    rest = rest.T
    moves = padded(motions.transpose(1, 2, 0), rest.shape[1]).reshape(-1, rest.shape[1])
    places = padded(trans.T, rest.shape[1])
    _skin_side_by_side(rest, moves, places, index, value, begin, end)
    _write_bodies(rest, out, begin, end)


@jit_noalloc
def _skin_side_by_side(rest, moves, places, index, value, begin, end):
    """``moves``: 12 rows a joint, as many bodies at once as there are lanes."""
    tile = end - begin
    for i in range(begin, end):
        row = i - begin
        for s in range(0, rest.shape[1], LANES * 8 // rest.itemsize):
            x = load_at(rest, row, s)
            y = load_at(rest, row + tile, s)
            z = load_at(rest, row + 2 * tile, s)
            u = load_at(places, 0, s)
            v = load_at(places, 1, s)
            w = load_at(places, 2, s)
            for k in range(index.shape[1]):
                share = value[i, k]
                if share != 0.0:
                    m = 12 * index[i, k]
                    a = x * share
                    b = y * share
                    c = z * share
                    u = u + load_at(moves, m, s) * a + load_at(moves, m + 1, s) * b
                    u = u + load_at(moves, m + 2, s) * c + load_at(moves, m + 3, s) * share
                    v = v + load_at(moves, m + 4, s) * a + load_at(moves, m + 5, s) * b
                    v = v + load_at(moves, m + 6, s) * c + load_at(moves, m + 7, s) * share
                    w = w + load_at(moves, m + 8, s) * a + load_at(moves, m + 9, s) * b
                    w = w + load_at(moves, m + 10, s) * c + load_at(moves, m + 11, s) * share
            store_at(rest, row, s, u)
            store_at(rest, row + tile, s, v)
            store_at(rest, row + 2 * tile, s, w)


@jit_noalloc
def _write_bodies(posed, out, begin, end):
    """Vertices begin..end of bodies side by side, written body by body."""
    tile = end - begin
    for first in range(0, len(out), STREAMS):
        for i in range(tile):
            for s in range(first, min(first + STREAMS, len(out))):
                out[s, begin + i, 0] = posed[i, s]
                out[s, begin + i, 1] = posed[i + tile, s]
                out[s, begin + i, 2] = posed[i + 2 * tile, s]
