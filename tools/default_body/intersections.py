"""Where a triangle mesh cuts itself, and triangles that are turned over: a fast count for many bodies of one mesh."""

from __future__ import annotations

import numba
import numpy as np

CELL = 0.012  # metres: side of the grid's cells, about a triangle's size
PRIME_X, PRIME_Y, PRIME_Z = 73856093, 19349663, 83492791


def intersecting_pairs(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pairs (K, 2) of triangles (F, 3) over vertices (V, 3) that cut each other and share no vertex."""
    corners = vertices[faces].astype(np.float64)
    low, high = corners.min(1), corners.max(1)
    first, last = np.floor(low / CELL).astype(np.int64), np.floor(high / CELL).astype(np.int64)
    face, cell = _cells(first, last)
    key = cell[:, 0] * PRIME_X ^ cell[:, 1] * PRIME_Y ^ cell[:, 2] * PRIME_Z
    order = np.argsort(key, kind="stable")
    found = _pairs(corners, low, high, faces.astype(np.int64), face[order], key[order])
    return np.unique(found, axis=0) if len(found) else np.zeros((0, 2), np.int64)


def turned_over(vertices: np.ndarray, faces: np.ndarray, template: np.ndarray) -> np.ndarray:
    """(F,) True for triangles whose normal points more than a right angle away from the template's."""

    def normals(points: np.ndarray) -> np.ndarray:
        a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
        return np.cross(b - a, c - a)

    return (normals(vertices) * normals(template)).sum(1) <= 0


def _cells(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every (triangle, cell) in which a triangle's box lies."""
    size = last - first + 1
    count = size.prod(1)
    face = np.repeat(np.arange(len(first)), count)
    rank = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    sy, sz = size[face, 1], size[face, 2]
    step = np.column_stack([rank // (sy * sz), rank // sz % sy, rank % sz])
    return face, first[face] + step


@numba.njit
def _pairs(corners, low, high, faces, face, key):
    found = []
    start = 0
    count = len(face)
    while start < count:
        stop = start + 1
        while stop < count and key[stop] == key[start]:
            stop += 1
        for i in range(start, stop):
            a = face[i]
            for j in range(i + 1, stop):
                b = face[j]
                if a == b or not _boxes_meet(low, high, a, b) or _share(faces, a, b):
                    continue
                if _triangles_cut(corners[a], corners[b]):
                    found.append((min(a, b), max(a, b)))
        start = stop
    out = np.empty((len(found), 2), np.int64)
    for k in range(len(found)):
        out[k, 0], out[k, 1] = found[k]
    return out


@numba.njit
def _boxes_meet(low, high, a, b):
    for c in range(3):  # noqa: SIM110
        if low[a, c] > high[b, c] or low[b, c] > high[a, c]:
            return False
    return True


@numba.njit
def _share(faces, a, b):
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                return True
    return False


@numba.njit
def _triangles_cut(p, q):
    """Whether an edge of one triangle passes through the other."""
    for k in range(3):  # noqa: SIM110
        if _segment_cuts(p[k], p[(k + 1) % 3], q) or _segment_cuts(q[k], q[(k + 1) % 3], p):
            return True
    return False


@numba.njit
def _segment_cuts(a, b, t):
    """Möller and Trumbore's test of the segment from a to b with triangle t (3, 3)."""
    d0, d1, d2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    e0, e1, e2 = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    f0, f1, f2 = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    h0, h1, h2 = d1 * f2 - d2 * f1, d2 * f0 - d0 * f2, d0 * f1 - d1 * f0
    det = e0 * h0 + e1 * h1 + e2 * h2
    if abs(det) < 1e-18:
        return False
    s0, s1, s2 = a[0] - t[0, 0], a[1] - t[0, 1], a[2] - t[0, 2]
    u = (s0 * h0 + s1 * h1 + s2 * h2) / det
    if u < 0 or u > 1:
        return False
    q0, q1, q2 = s1 * e2 - s2 * e1, s2 * e0 - s0 * e2, s0 * e1 - s1 * e0
    v = (d0 * q0 + d1 * q1 + d2 * q2) / det
    if v < 0 or u + v > 1:
        return False
    w = (f0 * q0 + f1 * q1 + f2 * q2) / det
    return 0 <= w <= 1
