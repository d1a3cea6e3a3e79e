"""Compiled VJPs of the images of `surfaces.py`: cotangents of screen, values and background from an
image's.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.images import HUGE
from habitus.render.kernels.samples import add_barycentrics_vjp, corners_of, share_of_pixel
from habitus.render.kernels.surfaces import at_point, face_corners, value_at


@jit_noalloc
def draw_values_vjp(
    screen, faces, ids, values, cotangent, exact, begin, end, to_screen, to_values, to_background
):
    """VJP of `draw_values`, rows begin..end: add to the cotangents of screen (V, 3), values (V, C)
    and background.

    Nothing is added for a background of no rows: one that needs no derivative.
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
                behind = first + x if len(to_background) > 1 else np.uintp(0)
                for k in range(channels if len(to_background) > 0 else np.uintp(0)):
                    to_background[behind, k] += cotangent[first + x, k]
                x += one
                continue
            while x < width and ids[row, x] == f:
                x += one
            corners = face_corners(faces, f)
            _run_vjp(
                screen,
                corners,
                values,
                cotangent,
                first + start,
                x - start,
                start + 0.5,
                row + 0.5,
                exact,
                to_screen,
                to_values,
            )


@jit_inline
def _run_vjp(screen, corners, values, cotangent, pixel, count, x, y, exact, to_screen, to_values):
    """VJP of `count` pixels in a row that show one face, the first of them centred at (x, y).

    `samples.add_barycentrics_vjp` has the formulas. Coordinates l on the screen are linear along
    the row, so that sums over pixels of cotangent / w and value * cotangent / w, and of these times
    the step t, suffice.
    """
    a, b, c = corners
    ax, ay, wa, bx, by, wb, cx, cy, wc = corners_of(screen, a, b, c)
    scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    counts = -scale if exact else -scale * share_of_pixel(bx - ax, by - ay, cx - bx, cy - by)
    la = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * scale
    da = (by - cy) * scale
    lb = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * scale
    db = (cy - ay) * scale
    lc = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) * scale
    dc = (ay - by) * scale
    here = (la * wa, lb * wb, lc * wc)
    steps = (da * wa, db * wb, dc * wc)
    weights = here, steps, here[0] + here[1] + here[2], steps[0] + steps[1] + steps[2]
    sums = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    first = np.uintp(0)
    if values.shape[1] == 3:
        sums = _three_channels_vjp(corners, values, cotangent, pixel, count, weights, to_values)
        first = np.uintp(3)
    for k in range(first, np.uintp(values.shape[1])):
        sums = _channel_vjp(corners, values, cotangent, pixel, count, k, weights, to_values, sums)
    p, tp, q, tq, r, tr, e, te = sums
    p = wa * p
    tp = wa * tp
    q = wb * q
    tq = wb * tq
    r = wc * r
    tr = wc * tr
    w_x = wa * (by - cy) + wb * (cy - ay) + wc * (ay - by)
    w_y = wa * (cx - bx) + wb * (ax - cx) + wc * (bx - ax)
    gx = p * (by - cy) + q * (cy - ay) + r * (ay - by) - w_x * e
    gy = p * (cx - bx) + q * (ax - cx) + r * (bx - ax) - w_y * e
    tx = tp * (by - cy) + tq * (cy - ay) + tr * (ay - by) - w_x * te
    ty = tp * (cx - bx) + tq * (ax - cx) + tr * (bx - ax) - w_y * te
    ea = la * e + da * te
    eb = lb * e + db * te
    ec = lc * e + dc * te
    pa = la * p + da * tp
    qb = lb * q + db * tq
    rc = lc * r + dc * tr
    _add(
        to_screen,
        a,
        counts * (la * gx + da * tx),
        counts * (la * gy + da * ty),
        wa * (wa * ea - pa),
    )
    _add(
        to_screen,
        b,
        counts * (lb * gx + db * tx),
        counts * (lb * gy + db * ty),
        wb * (wb * eb - qb),
    )
    _add(
        to_screen,
        c,
        counts * (lc * gx + dc * tx),
        counts * (lc * gy + dc * ty),
        wc * (wc * ec - rc),
    )


@jit_inline
def _channel_vjp(corners, values, cotangent, pixel, count, k, weights, to_values, sums):
    """One channel of `_run_vjp`: adds to the cotangents of values, and gives the sums with those of
    the channel.

    sums: cotangent / w times the value of each corner and, after it, times the step too; cotangent
    * value / w and this times the step.
    """
    here, steps, w, dw = weights
    at = _channel(values, corners, k, here)
    change = _channel(values, corners, k, steps)
    s_sum = ts_sum = e_sum = te_sum = 0.0
    for n in range(np.intp(count)):
        t = float(n)
        depth = 1.0 / (w + t * dw)
        s = cotangent[pixel + np.uintp(n), k] * depth
        e = s * (at + t * change) * depth
        s_sum = s_sum + s
        ts_sum = ts_sum + t * s
        e_sum = e_sum + e
        te_sum = te_sum + t * e
    return _summed(corners, values, k, weights, s_sum, ts_sum, to_values, sums, e_sum, te_sum)


@jit_inline
def _three_channels_vjp(corners, values, cotangent, pixel, count, weights, to_values):
    """`_channel_vjp` of three channels at once: colours, whose pixels share a depth."""
    here, steps, w, dw = weights
    red = np.uintp(0)
    green = np.uintp(1)
    blue = np.uintp(2)
    v0 = _channel(values, corners, red, here)
    d0 = _channel(values, corners, red, steps)
    v1 = _channel(values, corners, green, here)
    d1 = _channel(values, corners, green, steps)
    v2 = _channel(values, corners, blue, here)
    d2 = _channel(values, corners, blue, steps)
    s0 = s1 = s2 = t0 = t1 = t2 = e_sum = te_sum = 0.0
    for n in range(np.intp(count)):
        t = float(n)
        at = pixel + np.uintp(n)
        depth = 1.0 / (w + t * dw)
        a = cotangent[at, 0] * depth
        b = cotangent[at, 1] * depth
        c = cotangent[at, 2] * depth
        e = (a * (v0 + t * d0) + b * (v1 + t * d1) + c * (v2 + t * d2)) * depth
        s0 = s0 + a
        s1 = s1 + b
        s2 = s2 + c
        t0 = t0 + t * a
        t1 = t1 + t * b
        t2 = t2 + t * c
        e_sum = e_sum + e
        te_sum = te_sum + t * e
    sums = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, e_sum, te_sum
    sums = _summed(corners, values, red, weights, s0, t0, to_values, sums, 0.0, 0.0)
    sums = _summed(corners, values, green, weights, s1, t1, to_values, sums, 0.0, 0.0)
    return _summed(corners, values, blue, weights, s2, t2, to_values, sums, 0.0, 0.0)


@jit_inline
def _channel(values, corners, k, weights):
    """Channel k of a face's corners, times three weights."""
    a, b, c = corners
    return weights[0] * values[a, k] + weights[1] * values[b, k] + weights[2] * values[c, k]


@jit_inline
def _summed(corners, values, k, weights, s, ts, to_values, sums, e, te):
    """Add a channel's sums to the cotangents of values and to `sums`."""
    a, b, c = corners
    (pa, pb, pc), (da, db, dc), _, _ = weights
    to_values[a, k] += pa * s + da * ts
    to_values[b, k] += pb * s + db * ts
    to_values[c, k] += pc * s + dc * ts
    va = values[a, k]
    vb = values[b, k]
    vc = values[c, k]
    p, tp, q, tq, r, tr, all_e, all_te = sums
    return (
        p + va * s,
        tp + va * ts,
        q + vb * s,
        tq + vb * ts,
        r + vc * s,
        tr + vc * ts,
        all_e + e,
        all_te + te,
    )


@jit_noalloc
def draw_jumps_vjp(
    screen, faces, values, background, fragments, cotangent, exact, begin, end, to_screen, to_values, to_background,  # noqa: E501
    to_weight
):  # fmt: skip
    """VJP of `draw_jumps`: added to the cotangents of screen, values and background, written to
    that of weights.
    """
    pixel, weight, inner_face, inner_point, outer_face, outer_point = fragments
    for s in range(begin, end):
        behind = pixel[s] if len(background) > 1 else 0
        inner = at_point(screen, faces, inner_face[s], inner_point[s, 0], inner_point[s, 1])
        outer = at_point(screen, faces, outer_face[s], outer_point[s, 0], outer_point[s, 1])
        total = 0.0
        for k in range(values.shape[1]):
            jump = value_at(outer, values, background, behind, k) - value_at(
                inner, values, background, behind, k
            )
            if abs(jump) < HUGE:
                total += cotangent[pixel[s], k] * jump
        to_weight[s] = total
        for side in range(2 if weight[s] != 0.0 else 0):
            at = inner
            scale = -weight[s]
            x = inner_point[s, 0]
            y = inner_point[s, 1]
            if side == 1:
                at = outer
                scale = weight[s]
                x = outer_point[s, 0]
                y = outer_point[s, 1]
            a, b, c, p, q, r = at
            ga = gb = gc = 0.0
            for k in range(values.shape[1]):
                jump = value_at(outer, values, background, behind, k) - value_at(
                    inner, values, background, behind, k
                )
                change = scale * cotangent[pixel[s], k]
                if not abs(jump) < HUGE:
                    continue
                if a < 0:
                    if len(to_background):
                        to_background[behind, k] += change
                    continue
                to_values[a, k] += p * change
                to_values[b, k] += q * change
                to_values[c, k] += r * change
                ga += values[a, k] * change
                gb += values[b, k] * change
                gc += values[c, k] * change
            if a >= 0:
                add_barycentrics_vjp(screen, a, b, c, x, y, p, q, r, ga, gb, gc, exact, to_screen)


@jit_inline
def _add(to, row, x, y, z):
    """Add three numbers to a row."""
    to[row, 0] += x
    to[row, 1] += y
    to[row, 2] += z
