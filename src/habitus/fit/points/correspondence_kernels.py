"""The nearest place on the faces around some vertices, compiled."""

import math

import numpy as np

from habitus.kernels.jit import jit, jit_inline
from habitus.mesh.closest_kernels import nearest_in_face


@jit
def nearest_around(vertices, faces, start, around, points, close, found, share, place):
    """Into found (N,), share (N, 3) and place (N, 3): of the faces around the vertices close (N, K)
    the nearest.
    """
    near = np.empty(3)
    for p in range(len(points)):
        least = math.inf
        for k in range(close.shape[1]):
            i = close[p, k]
            for s in range(start[i], start[i + 1]):
                distance = nearest_in_face(points[p], vertices, faces[around[s]], near)
                if distance < least:
                    least, found[p] = distance, around[s]
                    place[p, 0], place[p, 1], place[p, 2] = near[0], near[1], near[2]
        _shares(place[p], vertices, faces[found[p]], share[p])


@jit_inline
def _shares(q, vertices, face, out):
    """Weights of a face's corners at a place on it."""
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    ee = ef = ff = pe = pf = 0.0
    for k in range(3):
        e = b[k] - a[k]
        f = c[k] - a[k]
        p = q[k] - a[k]
        ee = ee + e * e
        ef = ef + e * f
        ff = ff + f * f
        pe = pe + p * e
        pf = pf + p * f
    whole = ee * ff - ef * ef
    if whole > 0.0:
        out[1], out[2] = (ff * pe - ef * pf) / whole, (ee * pf - ef * pe) / whole
    else:
        out[1] = out[2] = 0.0
    out[0] = 1.0 - out[1] - out[2]
