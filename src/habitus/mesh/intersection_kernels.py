"""Pairs of triangles that cut each other, compiled."""

import numpy as np

from habitus.kernels.jit import jit, jit_inline


@jit
def cutting_pairs(corners, low, high, faces, face, key):
    """Pairs (K, 2), some of them twice, of triangles with these corners (F, 3, 3) and boxes (F, 3)
    that cut each other.

    face (M,) are triangles in the order of the cells, key (M,), in which they lie.
    """
    pairs = np.empty((256, 2), np.int64)
    begin = size = 0
    while begin < len(face):
        end = begin + 1
        while end < len(face) and key[end] == key[begin]:
            end += 1
        for i in range(begin, end):
            for j in range(i + 1, end):
                a = min(face[i], face[j])
                b = max(face[i], face[j])
                if a == b or not _boxes_meet(low, high, a, b) or _share(faces, a, b):
                    continue
                if _triangles_cut(corners[a], corners[b]):
                    if size == len(pairs):
                        pairs = np.concatenate((pairs, np.empty_like(pairs)))
                    pairs[size, 0], pairs[size, 1] = a, b
                    size += 1
        begin = end
    return pairs[:size]


@jit_inline
def _boxes_meet(low, high, a, b):
    for c in range(3):  # noqa: SIM110
        if low[a, c] > high[b, c] or low[b, c] > high[a, c]:
            return False
    return True


@jit_inline
def _share(faces, a, b):
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                return True
    return False


@jit_inline
def _triangles_cut(p, q):
    """Whether an edge of one triangle passes through the other."""
    for k in range(3):
        if _segment_cuts(p[k], p[(k + 1) % 3], q) or _segment_cuts(q[k], q[(k + 1) % 3], p):
            return True
    return False


@jit_inline
def _segment_cuts(a, b, t):
    """Möller and Trumbore's test of the segment from a to b with triangle t (3, 3)."""
    d0 = b[0] - a[0]
    d1 = b[1] - a[1]
    d2 = b[2] - a[2]
    e0 = t[1, 0] - t[0, 0]
    e1 = t[1, 1] - t[0, 1]
    e2 = t[1, 2] - t[0, 2]
    f0 = t[2, 0] - t[0, 0]
    f1 = t[2, 1] - t[0, 1]
    f2 = t[2, 2] - t[0, 2]
    h0 = d1 * f2 - d2 * f1
    h1 = d2 * f0 - d0 * f2
    h2 = d0 * f1 - d1 * f0
    det = e0 * h0 + e1 * h1 + e2 * h2
    if abs(det) < 1e-18:
        return False
    s0 = a[0] - t[0, 0]
    s1 = a[1] - t[0, 1]
    s2 = a[2] - t[0, 2]
    u = (s0 * h0 + s1 * h1 + s2 * h2) / det
    if u < 0 or u > 1:
        return False
    q0 = s1 * e2 - s2 * e1
    q1 = s2 * e0 - s0 * e2
    q2 = s0 * e1 - s1 * e0
    v = (d0 * q0 + d1 * q1 + d2 * q2) / det
    if v < 0 or u + v > 1:
        return False
    w = (f0 * q0 + f1 * q1 + f2 * q2) / det
    return 0 <= w <= 1
