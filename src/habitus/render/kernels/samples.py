"""Compiled samples of triangles: barycentric coordinates and values there, and the VJPs of both.

A sample is a point of the screen on a face: b and v of `render/README.md`. `reference/images.py` is
the reference. Positions are float64 inside, whatever the screen's type: on a sliver, float32 would
leave the face.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.vectors import greater, lesser


@jit_noalloc
def barycentrics(screen, faces, sample_faces, points, begin, end, out):
    """Perspective-correct barycentric coordinates of points on their faces."""
    for n in range(begin, end):
        f = sample_faces[n]
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        x = points[n, 0]
        y = points[n, 1]
        ax = np.float64(screen[a, 0])
        ay = np.float64(screen[a, 1])
        bx = np.float64(screen[b, 0])
        by = np.float64(screen[b, 1])
        cx = np.float64(screen[c, 0])
        cy = np.float64(screen[c, 1])
        p = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) / screen[a, 2]
        q = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) / screen[b, 2]
        r = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / screen[c, 2]
        scale = 1.0 / (p + q + r)
        out[n, 0], out[n, 1], out[n, 2] = p * scale, q * scale, r * scale


@jit_noalloc
def barycentrics_vjp(
    screen, faces, sample_faces, points, barycentrics, cotangent, exact, begin, end, out
):
    """Add to `out` (V, 3) the cotangent of the screen, given that of barycentric coordinates."""
    for n in range(begin, end):
        f = sample_faces[n]
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        p = barycentrics[n, 0]
        q = barycentrics[n, 1]
        r = barycentrics[n, 2]
        ga = cotangent[n, 0]
        gb = cotangent[n, 1]
        gc = cotangent[n, 2]
        add_barycentrics_vjp(
            screen, a, b, c, points[n, 0], points[n, 1], p, q, r, ga, gb, gc, exact, out
        )


@jit_inline
def add_barycentrics_vjp(screen, a, b, c, x, y, p, q, r, ga, gb, gc, exact, out):
    """Add to `out` (V, 3) the cotangent of the screen, given (ga, gb, gc), that of one point's
    coordinates (p, q, r).

    With l the coordinates on the screen, moving corner j by d moves l by -(grad l) l_j d; b_i =
    (l_i / z_i) / sum. On slivers that counts by `share_of_pixel` only, unless `exact`.
    """
    ax, ay, wa, bx, by, wb, cx, cy, wc = corners_of(screen, a, b, c)
    scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    la = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * scale
    lb = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * scale
    lc = 1.0 - la - lb
    depth = 1.0 / (la * wa + lb * wb + lc * wc)
    mean = ga * p + gb * q + gc * r
    ga = (ga - mean) * depth * wa
    gb = (gb - mean) * depth * wb
    gc = (gc - mean) * depth * wc
    counts = -scale if exact else -scale * share_of_pixel(bx - ax, by - ay, cx - bx, cy - by)
    gx = counts * (ga * (by - cy) + gb * (cy - ay) + gc * (ay - by))
    gy = counts * (ga * (cx - bx) + gb * (ax - cx) + gc * (bx - ax))
    out[a, 0] += la * gx
    out[a, 1] += la * gy
    out[a, 2] -= ga * la * wa
    out[b, 0] += lb * gx
    out[b, 1] += lb * gy
    out[b, 2] -= gb * lb * wb
    out[c, 0] += lc * gx
    out[c, 1] += lc * gy
    out[c, 2] -= gc * lc * wc


@jit_inline
def corners_of(screen, a, b, c):
    """Positions (float64) and inverse depths of a face's corners."""
    ax = np.float64(screen[a, 0])
    ay = np.float64(screen[a, 1])
    wa = 1.0 / screen[a, 2]
    bx = np.float64(screen[b, 0])
    by = np.float64(screen[b, 1])
    wb = 1.0 / screen[b, 2]
    cx = np.float64(screen[c, 0])
    cy = np.float64(screen[c, 1])
    wc = 1.0 / screen[c, 2]
    return ax, ay, wa, bx, by, wb, cx, cy, wc


@jit_inline
def share_of_pixel(ax, ay, bx, by):
    """How much of a pixel a triangle with sides a and b can speak for (see the reference's)."""
    cx = ax + bx
    cy = ay + by
    square = greater(greater(ax * ax + ay * ay, bx * bx + by * by), cx * cx + cy * cy)
    double_area = abs(ax * by - ay * bx)
    if 2.0 * double_area >= LONG * np.sqrt(square):
        return 1.0
    return lesser(2.0 * double_area / lesser(square, LONG * np.sqrt(square)), 1.0)


@jit_noalloc
def interpolate(values, faces, sample_faces, barycentrics, begin, end, out):
    """Values (V, C) at samples: their corners' mean, weighted by barycentric coordinates."""
    for n in range(begin, end):
        f = sample_faces[n]
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        p = barycentrics[n, 0]
        q = barycentrics[n, 1]
        r = barycentrics[n, 2]
        for k in range(values.shape[1]):
            out[n, k] = p * values[a, k] + q * values[b, k] + r * values[c, k]


@jit_noalloc
def interpolate_vjp(
    values, faces, sample_faces, barycentrics, cotangent, begin, end, to_values, to_barycentrics
):
    """VJP of `interpolate`: added to the cotangent of vertices' values, written to that of
    barycentric coordinates.
    """
    for n in range(begin, end):
        f = sample_faces[n]
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        p = barycentrics[n, 0]
        q = barycentrics[n, 1]
        r = barycentrics[n, 2]
        ga = gb = gc = 0.0
        for k in range(values.shape[1]):
            change = cotangent[n, k]
            to_values[a, k] += p * change
            to_values[b, k] += q * change
            to_values[c, k] += r * change
            ga += values[a, k] * change
            gb += values[b, k] * change
            gc += values[c, k] * change
        to_barycentrics[n, 0], to_barycentrics[n, 1], to_barycentrics[n, 2] = ga, gb, gc


LONG = 3.0
"""Pixels: from this length on triangles less high than half of it are slivers, shorter ones if they
are slender.
"""
