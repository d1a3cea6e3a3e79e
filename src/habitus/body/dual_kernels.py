"""Dual quaternion blend skinning (S 3, eq. 2), compiled; of `habitus.body.kernels`."""

import math

from habitus.kernels.jit import jit_inline, jit_noalloc


@jit_noalloc
def skin_dual(rest, quaternions, trans, index, value, out, begin, end):
    """Dual quaternion blend skinning; each quaternion on the side of the vertex' strongest
    joint's.
    """
    tile = end - begin
    for s in range(len(out)):
        carriers = quaternions[s]
        t = trans[s]
        for i in range(begin, end):
            main = 0
            for k in range(1, index.shape[1]):
                if value[i, k] > value[i, main]:
                    main = k
            lead = carriers[index[i, main]]
            a = b = c = d = e = f = g = h = lead[0] * 0.0
            for k in range(index.shape[1]):
                q = carriers[index[i, k]]
                share = value[i, k]
                if q[0] * lead[0] + q[1] * lead[1] + q[2] * lead[2] + q[3] * lead[3] < 0.0:
                    share = -share
                a = a + share * q[0]
                b = b + share * q[1]
                c = c + share * q[2]
                d = d + share * q[3]
                e = e + share * q[4]
                f = f + share * q[5]
                g = g + share * q[6]
                h = h + share * q[7]
            x = rest[s, i - begin]
            y = rest[s, i - begin + tile]
            z = rest[s, i - begin + 2 * tile]
            u = c * z - d * y + a * x + f
            v = d * x - b * z + a * y + g
            w = b * y - c * x + a * z + h
            scale = 2.0 / (a * a + b * b + c * c + d * d)
            out[s, i, 0] = t[0] + x + scale * (c * w - d * v + a * f - e * b)
            out[s, i, 1] = t[1] + y + scale * (d * u - b * w + a * g - e * c)
            out[s, i, 2] = t[2] + z + scale * (b * v - c * u + a * h - e * d)


@jit_noalloc
def dual_quaternions(motions, out):
    """Unit dual quaternions (real, dual) of rigid motions [R | t] row by row."""
    for s in range(len(motions)):
        for j in range(motions.shape[1]):
            m = motions[s, j]
            q = out[s, j]
            _quaternion(m, q)
            w = q[0]
            x = q[1]
            y = q[2]
            z = q[3]
            t = m[3]
            u = m[7]
            v = m[11]
            q[4] = -0.5 * (t * x + u * y + v * z)
            q[5] = 0.5 * (t * w + u * z - v * y)
            q[6] = 0.5 * (u * w + v * x - t * z)
            q[7] = 0.5 * (v * w + t * y - u * x)


@jit_inline
def _quaternion(m, q):
    """The unit quaternion of the rotation in [R | t]: of four equal formulas, the one that divides
    by the largest.
    """
    a = m[0]
    b = m[1]
    c = m[2]
    d = m[4]
    e = m[5]
    f = m[6]
    g = m[8]
    h = m[9]
    i = m[10]
    w = 1.0 + a + e + i
    x = 1.0 + a - e - i
    y = 1.0 - a + e - i
    z = 1.0 - a - e + i
    best = max(w, x, y, z)
    if w == best:
        q[0], q[1], q[2], q[3] = w, h - f, c - g, d - b
    elif x == best:
        q[0], q[1], q[2], q[3] = h - f, x, b + d, c + g
    elif y == best:
        q[0], q[1], q[2], q[3] = c - g, b + d, y, f + h
    else:
        q[0], q[1], q[2], q[3] = d - b, c + g, f + h, z
    scale = 1.0 / (2.0 * math.sqrt(best))
    for k in range(4):
        q[k] *= scale
