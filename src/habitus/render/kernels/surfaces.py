"""Compiled images of vertices' values: pixels straight from the face that each shows.

The sum of `render/README.md` in one pass: the same numbers as `samples.py` and `images.py` one
after the other, without lists of samples in between: an image's time goes to memory. A row's
neighbours mostly show the same face, whose corners are fetched once.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.images import HUGE
from habitus.render.kernels.samples import corners_of


@jit_noalloc
def draw_values(screen, faces, ids, values, background, begin, end, image):
    """Rows begin..end: values (V, C) at pixels' centres, linear on faces in space; elsewhere the
    background.

    Value over depth and inverse depth are linear on the screen: each is a start and a step for the
    pixels in a row that show one face. Unsigned numbers spare the question whether an index counts
    from the end.
    """
    width = np.uintp(ids.shape[1])
    channels = np.uintp(values.shape[1])
    one = np.uintp(1)
    for row in range(np.uintp(begin), np.uintp(end)):
        x = np.uintp(0)
        first = row * width
        while x < width:
            f = ids[row, x]
            start = x
            if f < 0:
                while x < width and ids[row, x] < 0:
                    x += one
                _lay_background(background, first + start, first + x, image)
                continue
            a, b, c = face_corners(faces, f)
            p, q, r, dp, dq, dr = _flat_shares(corners_of(screen, a, b, c), x + 0.5, row + 0.5)
            w = p + q + r
            dw = dp + dq + dr
            t = 0.0
            if channels == 3:
                zero = np.uintp(0)
                two = np.uintp(2)
                v0 = _along(values, a, b, c, zero, p, q, r)
                d0 = _along(values, a, b, c, zero, dp, dq, dr)
                v1 = _along(values, a, b, c, one, p, q, r)
                d1 = _along(values, a, b, c, one, dp, dq, dr)
                v2 = _along(values, a, b, c, two, p, q, r)
                d2 = _along(values, a, b, c, two, dp, dq, dr)
                while x < width and ids[row, x] == f:
                    depth = 1.0 / (w + t * dw)
                    image[first + x, 0] = (v0 + t * d0) * depth
                    image[first + x, 1] = (v1 + t * d1) * depth
                    image[first + x, 2] = (v2 + t * d2) * depth
                    x = x + one
                    t = t + 1.0
                continue
            while x < width and ids[row, x] == f:
                x += one
            for k in range(channels):
                v = _along(values, a, b, c, k, p, q, r)
                dv = _along(values, a, b, c, k, dp, dq, dr)
                for at in range(start, x):
                    t = float(np.intp(at - start))
                    image[first + at, k] = (v + t * dv) / (w + t * dw)


@jit_inline
def _lay_background(background, begin, end, image):
    """Pixels begin..end, which show no face."""
    if image.shape[1] == 3 and len(background) == 1:
        a = background[0, 0]
        b = background[0, 1]
        c = background[0, 2]
        for at in range(begin, end):
            image[at, 0], image[at, 1], image[at, 2] = a, b, c
        return
    for at in range(begin, end):
        behind = at if len(background) > 1 else np.uintp(0)
        for k in range(np.uintp(image.shape[1])):
            image[at, k] = background[behind, k]


@jit_noalloc
def draw_depths(inverse, ids, background, begin, end, image):
    """Rows begin..end: depth where a face shows, elsewhere the background. inverse: 1 / depth at
    pixels' centres.
    """
    width = np.uintp(ids.shape[1])
    at_infinity = background[0, 0]
    for row in range(np.uintp(begin), np.uintp(end)):
        first = row * width
        if len(background) > 1:
            for x in range(width):
                image[first + x, 0] = (
                    1.0 / inverse[row, x] if ids[row, x] >= 0 else background[first + x, 0]
                )
        else:
            for x in range(width):
                depth = 1.0 / inverse[row, x]
                image[first + x, 0] = depth if ids[row, x] >= 0 else at_infinity


@jit_noalloc
def draw_jumps(screen, faces, values, background, fragments, begin, end, image):
    """Add the jumps of fragments begin..end times their weights; `images.add_jumps` says which are
    left out.
    """
    pixel, weight, inner_face, inner_point, outer_face, outer_point = fragments
    for s in range(begin, end):
        if weight[s] == 0.0:
            continue
        behind = pixel[s] if len(background) > 1 else 0
        inner = at_point(screen, faces, inner_face[s], inner_point[s, 0], inner_point[s, 1])
        outer = at_point(screen, faces, outer_face[s], outer_point[s, 0], outer_point[s, 1])
        for k in range(values.shape[1]):
            jump = value_at(outer, values, background, behind, k) - value_at(
                inner, values, background, behind, k
            )
            if abs(jump) < HUGE:
                image[pixel[s], k] += weight[s] * jump


@jit_inline
def face_corners(faces, f):
    """The corners of a face."""
    n = np.uintp(f)
    return np.uintp(faces[n, 0]), np.uintp(faces[n, 1]), np.uintp(faces[n, 2])


@jit_inline
def _flat_shares(corners, x, y):
    """Barycentric coordinates of a point over depth, times the face's double area, and their steps
    along a row.
    """
    ax, ay, wa, bx, by, wb, cx, cy, wc = corners
    p = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * wa
    q = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * wb
    r = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) * wc
    return p, q, r, (by - cy) * wa, (cy - ay) * wb, (ay - by) * wc


@jit_inline
def _along(values, a, b, c, k, p, q, r):
    """Channel k of a face's corners, times p, q and r."""
    return p * values[a, k] + q * values[b, k] + r * values[c, k]


@jit_inline
def _shares(corners, x, y):
    """Perspective-correct barycentric coordinates of a point."""
    p, q, r, _, _, _ = _flat_shares(corners, x, y)
    scale = 1.0 / (p + q + r)
    return p * scale, q * scale, r * scale


@jit_inline
def at_point(screen, faces, f, x, y):
    """The corners of a face and the barycentric coordinates of a point on it; corners -1 for no
    face.
    """
    if f < 0:
        return np.int64(-1), np.int64(-1), np.int64(-1), 0.0, 0.0, 0.0
    a, b, c = face_corners(faces, f)
    p, q, r = _shares(corners_of(screen, a, b, c), x, y)
    return np.int64(a), np.int64(b), np.int64(c), p, q, r


@jit_inline
def value_at(at, values, background, behind, k):
    """Channel k at what `at_point` found."""
    a, b, c, p, q, r = at
    return (
        p * values[a, k] + q * values[b, k] + r * values[c, k]
        if a >= 0
        else np.float64(background[behind, k])
    )
