"""Compiled projection of points of the world to the screen, and its VJP; `Camera.screen` is the reference."""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc


@jit_noalloc
def project(points, focal, middle, turn, shift, lens, limit, screen):
    """Write u, v (pixels) and depth of points to `screen`, NaN unless x'^2 + y'^2 < limit.

    turn: rotation matrix (3, 3); lens: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6.
    """
    for v in range(len(points)):
        x, y, z = _moved(points, v, turn, shift)
        s = (x * x + y * y) / (z * z)
        if s < limit:
            a, b, _, _ = _bent(x / z, y / z, s, lens)
            screen[v, 0], screen[v, 1], screen[v, 2] = a * focal[0] + middle[0], b * focal[1] + middle[1], z
        else:
            screen[v, 0], screen[v, 1], screen[v, 2] = np.nan, np.nan, np.nan


@jit_noalloc
def project_vjp(points, focal, middle, turn, shift, lens, limit, cotangent, to_points, to_numbers):
    """VJP of `project`: writes `to_points` (V, 3), adds to the cotangents of the camera's numbers in their order.

    to_numbers: focal length and principal point 2 each, rotation matrix 9, translation 3, lens 8.
    """
    for v in range(len(points)):
        x, y, z = _moved(points, v, turn, shift)
        s = (x * x + y * y) / (z * z)
        to_points[v, 0] = to_points[v, 1] = to_points[v, 2] = 0.0
        if not s < limit:
            continue
        gu, gv, gz = cotangent[v, 0], cotangent[v, 1], cotangent[v, 2]
        if gu == 0.0 and gv == 0.0 and gz == 0.0:
            continue
        px, py = x / z, y / z
        a, b, radial, below = _bent(px, py, s, lens)
        to_numbers[0] += gu * a
        to_numbers[1] += gv * b
        to_numbers[2] += gu
        to_numbers[3] += gv
        ga, gb = gu * focal[0], gv * focal[1]
        gx, gy = _bent_vjp(px, py, s, lens, radial, below, ga, gb, to_numbers)
        gx, gy, gz = gx / z, gy / z, gz - (gx * px + gy * py) / z
        to_numbers[13] += gx
        to_numbers[14] += gy
        to_numbers[15] += gz
        for k in range(3):
            p = points[v, k]
            to_numbers[4 + k] += gx * p
            to_numbers[7 + k] += gy * p
            to_numbers[10 + k] += gz * p
            to_points[v, k] = gx * turn[0, k] + gy * turn[1, k] + gz * turn[2, k]


@jit_inline
def _moved(points, v, turn, shift):
    """A point in the camera's frame."""
    p, q, r = np.float64(points[v, 0]), np.float64(points[v, 1]), np.float64(points[v, 2])
    x = turn[0, 0] * p + turn[0, 1] * q + turn[0, 2] * r + shift[0]
    y = turn[1, 0] * p + turn[1, 1] * q + turn[1, 2] * r + shift[1]
    return x, y, turn[2, 0] * p + turn[2, 1] * q + turn[2, 2] * r + shift[2]


@jit_inline
def _bent(x, y, s, lens):
    """(x'', y'') of (x', y') as `observe.lens` has them, the radial factor, and what that is divided by."""
    below = 1.0 + s * (lens[5] + s * (lens[6] + s * lens[7]))
    radial = (1.0 + s * (lens[0] + s * (lens[1] + s * lens[4]))) / below
    a = x * radial + 2.0 * lens[2] * x * y + lens[3] * (s + 2.0 * x * x)
    return a, y * radial + lens[2] * (s + 2.0 * y * y) + 2.0 * lens[3] * x * y, radial, below


@jit_inline
def _bent_vjp(x, y, s, lens, radial, below, ga, gb, to_numbers):
    """The cotangent of (x', y'), given that of (x'', y''); adds to that of the lens."""
    along = ga * x + gb * y
    above, under = along / below, -along * radial / below
    to_numbers[16] += above * s
    to_numbers[17] += above * s * s
    to_numbers[20] += above * s * s * s
    to_numbers[21] += under * s
    to_numbers[22] += under * s * s
    to_numbers[23] += under * s * s * s
    to_numbers[18] += ga * 2.0 * x * y + gb * (s + 2.0 * y * y)
    to_numbers[19] += ga * (s + 2.0 * x * x) + gb * 2.0 * x * y
    slope = above * (lens[0] + s * (2.0 * lens[1] + s * 3.0 * lens[4]))
    slope += under * (lens[5] + s * (2.0 * lens[6] + s * 3.0 * lens[7]))
    slope += ga * lens[3] + gb * lens[2]
    gx = ga * (radial + 2.0 * lens[2] * y + 4.0 * lens[3] * x) + gb * 2.0 * lens[3] * y + 2.0 * x * slope
    return gx, gb * (radial + 4.0 * lens[2] * y + 2.0 * lens[3] * x) + ga * 2.0 * lens[2] * x + 2.0 * y * slope
