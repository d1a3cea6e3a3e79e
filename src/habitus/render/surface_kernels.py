"""Compiled images of vertices' values: pixels straight from the face that each shows, and what flows back.

The same numbers as `sample_kernels.py` and `image_kernels.py` one after the other, without lists of samples in between:
an image's time goes to memory. A row's neighbours mostly show the same face, whose corners are fetched once.
"""

import numpy as np

from habitus.compiled import lean, part
from habitus.render.image_kernels import HUGE
from habitus.render.sample_kernels import corners_of, pull_coordinates, share_of_pixel


@lean
def draw_values(screen, faces, ids, values, background, begin, end, image):
    """Rows begin..end: values (V, C) at pixels' centres, linear on faces in space; elsewhere the background.

    Value over depth and inverse depth are linear on the screen: each is a start and a step for the pixels in a row that
    show one face. Unsigned numbers spare the question whether an index counts from the end.
    """
    width, channels, one = np.uintp(ids.shape[1]), np.uintp(values.shape[1]), np.uintp(1)
    for row in range(np.uintp(begin), np.uintp(end)):
        x, first = np.uintp(0), row * width
        while x < width:
            f, start = ids[row, x], x
            if f < 0:
                behind = first + x if len(background) > 1 else np.uintp(0)
                for k in range(channels):
                    image[first + x, k] = background[behind, k]
                x += one
                continue
            a, b, c = _face(faces, f)
            p, q, r, dp, dq, dr = _flat_shares(corners_of(screen, a, b, c), x + 0.5, row + 0.5)
            w, dw, t = p + q + r, dp + dq + dr, 0.0
            if channels == 3:
                v0, d0 = _along(values, a, b, c, 0, p, q, r), _along(values, a, b, c, 0, dp, dq, dr)
                v1, d1 = _along(values, a, b, c, 1, p, q, r), _along(values, a, b, c, 1, dp, dq, dr)
                v2, d2 = _along(values, a, b, c, 2, p, q, r), _along(values, a, b, c, 2, dp, dq, dr)
                while x < width and ids[row, x] == f:
                    depth = 1.0 / (w + t * dw)
                    image[first + x, 0] = (v0 + t * d0) * depth
                    image[first + x, 1] = (v1 + t * d1) * depth
                    image[first + x, 2] = (v2 + t * d2) * depth
                    x, t = x + one, t + 1.0
                continue
            while x < width and ids[row, x] == f:
                x += one
            for k in range(channels):
                v, dv = _along(values, a, b, c, k, p, q, r), _along(values, a, b, c, k, dp, dq, dr)
                for at in range(start, x):
                    t = float(np.intp(at - start))
                    image[first + at, k] = (v + t * dv) / (w + t * dw)


@lean
def draw_depths(inverse, ids, background, begin, end, image):
    """Rows begin..end: depth where a face shows, elsewhere the background. inverse: 1 / depth at pixels' centres."""
    width, at_infinity = np.uintp(ids.shape[1]), background[0, 0]
    for row in range(np.uintp(begin), np.uintp(end)):
        first = row * width
        if len(background) > 1:
            for x in range(width):
                image[first + x, 0] = 1.0 / inverse[row, x] if ids[row, x] >= 0 else background[first + x, 0]
        else:
            for x in range(width):
                depth = 1.0 / inverse[row, x]
                image[first + x, 0] = depth if ids[row, x] >= 0 else at_infinity


@lean
def draw_jumps(screen, faces, values, background, parts, begin, end, image):
    """Add the jumps of parts begin..end times their weights; `image_kernels.add_jumps` says which are left out."""
    pixel, weight, inner_face, inner_point, outer_face, outer_point = parts
    for s in range(begin, end):
        behind = pixel[s] if len(background) > 1 else 0
        inner = _at(screen, faces, inner_face[s], inner_point[s, 0], inner_point[s, 1])
        outer = _at(screen, faces, outer_face[s], outer_point[s, 0], outer_point[s, 1])
        for k in range(values.shape[1]):
            jump = _value(outer, values, background, behind, k) - _value(inner, values, background, behind, k)
            if abs(jump) < HUGE:
                image[pixel[s], k] += weight[s] * jump


@lean
def pull_values(screen, faces, ids, values, slopes, begin, end, to_screen, to_values, to_background):
    """Rows begin..end: add what slopes (P, C) to pixels are to the screen (V, 3), to values (V, C), to the background.

    `sample_kernels.pull_coordinates` has the formulas; here sums over neighbours that show the same face come first.
    """
    width, channels = ids.shape[1], np.uintp(values.shape[1])
    for row in range(begin, end):
        y, last = row + 0.5, -1
        a = b = c = np.uintp(0)
        ax = ay = wa = bx = by = wb = cx = cy = wc = la = lb = lc = da = db = dc = counts = 0.0
        sum_a = sum_b = sum_c = (0.0, 0.0, 0.0)
        for column in range(width):
            f, pixel = ids[row, column], np.uintp(row * width + column)
            if f != last:
                if last >= 0:
                    _add(to_screen, a, sum_a)
                    _add(to_screen, b, sum_b)
                    _add(to_screen, c, sum_c)
                last = f
                if f >= 0:
                    a, b, c = _face(faces, f)
                    ax, ay, wa, bx, by, wb, cx, cy, wc = corners_of(screen, a, b, c)
                    scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
                    counts = -scale * share_of_pixel(bx - ax, by - ay, cx - bx, cy - by)
                    la, da = (cx - bx) * (y - by) * scale, (cy - by) * scale
                    lb, db = (ax - cx) * (y - cy) * scale, (ay - cy) * scale
                    lc, dc = (bx - ax) * (y - ay) * scale, (by - ay) * scale
                    sum_a = sum_b = sum_c = (0.0, 0.0, 0.0)
            if f < 0:
                behind = pixel if len(to_background) > 1 else np.uintp(0)
                for k in range(channels):
                    to_background[behind, k] += slopes[pixel, k]
                continue
            x = column + 0.5
            u, v, w = la - da * (x - bx), lb - db * (x - cx), lc - dc * (x - ax)
            depth = 1.0 / (u * wa + v * wb + w * wc)
            p, q, r = u * wa * depth, v * wb * depth, w * wc * depth
            ga = gb = gc = 0.0
            for k in range(channels):
                slope = np.float64(slopes[pixel, k])
                to_values[a, k] += p * slope
                to_values[b, k] += q * slope
                to_values[c, k] += r * slope
                ga += values[a, k] * slope
                gb += values[b, k] * slope
                gc += values[c, k] * slope
            mean = ga * p + gb * q + gc * r
            ga, gb, gc = (ga - mean) * depth * wa, (gb - mean) * depth * wb, (gc - mean) * depth * wc
            gx = counts * (ga * (by - cy) + gb * (cy - ay) + gc * (ay - by))
            gy = counts * (ga * (cx - bx) + gb * (ax - cx) + gc * (bx - ax))
            sum_a = (sum_a[0] + u * gx, sum_a[1] + u * gy, sum_a[2] - ga * u * wa)
            sum_b = (sum_b[0] + v * gx, sum_b[1] + v * gy, sum_b[2] - gb * v * wb)
            sum_c = (sum_c[0] + w * gx, sum_c[1] + w * gy, sum_c[2] - gc * w * wc)
        if last >= 0:
            _add(to_screen, a, sum_a)
            _add(to_screen, b, sum_b)
            _add(to_screen, c, sum_c)


@lean
def pull_jumps(
    screen, faces, values, background, parts, slopes, begin, end, to_screen, to_values, to_background, to_weight
):  # fmt: skip
    """What flows back through `draw_jumps`: added for screen, values and background, written for weights."""
    pixel, weight, inner_face, inner_point, outer_face, outer_point = parts
    for s in range(begin, end):
        behind = pixel[s] if len(background) > 1 else 0
        inner = _at(screen, faces, inner_face[s], inner_point[s, 0], inner_point[s, 1])
        outer = _at(screen, faces, outer_face[s], outer_point[s, 0], outer_point[s, 1])
        total = 0.0
        for k in range(values.shape[1]):
            jump = _value(outer, values, background, behind, k) - _value(inner, values, background, behind, k)
            if abs(jump) < HUGE:
                total += slopes[pixel[s], k] * jump
        to_weight[s] = total
        for side in range(2):
            at, scale, x, y = inner, -weight[s], inner_point[s, 0], inner_point[s, 1]
            if side == 1:
                at, scale, x, y = outer, weight[s], outer_point[s, 0], outer_point[s, 1]
            a, b, c, p, q, r = at
            ga = gb = gc = 0.0
            for k in range(values.shape[1]):
                jump = _value(outer, values, background, behind, k) - _value(inner, values, background, behind, k)
                slope = scale * slopes[pixel[s], k]
                if not abs(jump) < HUGE:
                    continue
                if a < 0:
                    to_background[behind, k] += slope
                    continue
                to_values[a, k] += p * slope
                to_values[b, k] += q * slope
                to_values[c, k] += r * slope
                ga += values[a, k] * slope
                gb += values[b, k] * slope
                gc += values[c, k] * slope
            if a >= 0:
                pull_coordinates(screen, a, b, c, x, y, p, q, r, ga, gb, gc, to_screen)


@part
def _face(faces, f):
    """The corners of a face."""
    n = np.uintp(f)
    return np.uintp(faces[n, 0]), np.uintp(faces[n, 1]), np.uintp(faces[n, 2])


@part
def _flat_shares(corners, x, y):
    """Barycentric coordinates of a point over depth, times the face's double area, and their steps along a row."""
    ax, ay, wa, bx, by, wb, cx, cy, wc = corners
    p = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * wa
    q = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * wb
    r = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) * wc
    return p, q, r, (by - cy) * wa, (cy - ay) * wb, (ay - by) * wc


@part
def _along(values, a, b, c, k, p, q, r):
    """Channel k of a face's corners, times p, q and r."""
    return p * values[a, k] + q * values[b, k] + r * values[c, k]


@part
def _add(to, row, numbers):
    """Add three numbers to a row."""
    to[row, 0] += numbers[0]
    to[row, 1] += numbers[1]
    to[row, 2] += numbers[2]


@part
def _shares(corners, x, y):
    """Perspective-correct barycentric coordinates of a point."""
    p, q, r, _, _, _ = _flat_shares(corners, x, y)
    scale = 1.0 / (p + q + r)
    return p * scale, q * scale, r * scale


@part
def _at(screen, faces, f, x, y):
    """The corners of a face and the barycentric coordinates of a point on it; corners -1 for no face."""
    if f < 0:
        return np.int64(-1), np.int64(-1), np.int64(-1), 0.0, 0.0, 0.0
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    p, q, r = _shares(corners_of(screen, a, b, c), x, y)
    return a, b, c, p, q, r


@part
def _value(at, values, background, behind, k):
    """Channel k at what `_at` found."""
    a, b, c, p, q, r = at
    return p * values[a, k] + q * values[b, k] + r * values[c, k] if a >= 0 else np.float64(background[behind, k])
