"""Compiled projection of points of the world to the screen, and its VJP; `Camera.screen` is the
reference.
"""

import math

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc


@jit_noalloc
def project(points, focal, middle, rotation, shift, lens, limit, screen):
    """Write u, v (pixels) and depth of points to `screen`, NaN unless x'^2 + y'^2 < limit.

    rotation: a rotation vector; lens: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6.
    """
    turn = _rotation(rotation)
    for v in range(len(points)):
        x, y, z = _moved(points, v, turn, shift)
        scale = 1.0 / z
        x = x * scale
        y = y * scale
        s = x * x + y * y
        if s < limit:
            a, b, _, _ = _bent(x, y, s, lens)
            screen[v, 0], screen[v, 1], screen[v, 2] = (
                a * focal[0] + middle[0],
                b * focal[1] + middle[1],
                z,
            )
        else:
            screen[v, 0], screen[v, 1], screen[v, 2] = np.nan, np.nan, np.nan


@jit_noalloc
def project_vjp(
    points, focal, middle, rotation, shift, lens, limit, cotangent, to_points, to_numbers
):
    """VJP of `project`: writes `to_points` (V, 3), adds to the cotangents of the camera's numbers
    in their order.

    to_numbers: focal length and principal point 2 each, rotation matrix 9, translation 3, lens 8.
    """
    turn = _rotation(rotation)
    for v in range(len(points)):
        x, y, z = _moved(points, v, turn, shift)
        px = x / z
        py = y / z
        s = px * px + py * py
        to_points[v, 0] = to_points[v, 1] = to_points[v, 2] = 0.0
        if not s < limit:
            continue
        gu = cotangent[v, 0]
        gv = cotangent[v, 1]
        gz = cotangent[v, 2]
        if gu == 0.0 and gv == 0.0 and gz == 0.0:
            continue
        a, b, radial, below = _bent(px, py, s, lens)
        to_numbers[0] += gu * a
        to_numbers[1] += gv * b
        to_numbers[2] += gu
        to_numbers[3] += gv
        ga = gu * focal[0]
        gb = gv * focal[1]
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
            to_points[v, k] = gx * turn[k] + gy * turn[3 + k] + gz * turn[6 + k]


@jit_inline
def _rotation(vector):
    """The matrix, rows first, of a rotation vector: `rotations.matrix_from_rotvec`."""
    x = np.float64(vector[0])
    y = np.float64(vector[1])
    z = np.float64(vector[2])
    squared = x * x + y * y + z * z
    sine = 1.0 - squared / 6.0
    versine = 0.5 - squared / 24.0  # over the angle and its square
    if squared > 1e-8:
        angle = math.sqrt(squared)
        half = math.sin(0.5 * angle)
        sine = math.sin(angle) / angle
        versine = 2.0 * half * half / squared
    bx = versine * x
    by = versine * y
    bz = versine * z
    xx = bx * x
    yy = by * y
    zz = bz * z
    xy = bx * y
    xz = bx * z
    yz = by * z
    ax = sine * x
    ay = sine * y
    az = sine * z
    return (
        1.0 - yy - zz,
        xy - az,
        xz + ay,
        xy + az,
        1.0 - xx - zz,
        yz - ax,
        xz - ay,
        yz + ax,
        1.0 - xx - yy,
    )


@jit_inline
def _moved(points, v, turn, shift):
    """A point in the camera's frame."""
    p = np.float64(points[v, 0])
    q = np.float64(points[v, 1])
    r = np.float64(points[v, 2])
    x = turn[0] * p + turn[1] * q + turn[2] * r + shift[0]
    y = turn[3] * p + turn[4] * q + turn[5] * r + shift[1]
    return x, y, turn[6] * p + turn[7] * q + turn[8] * r + shift[2]


@jit_inline
def _bent(x, y, s, lens):
    """(x'', y'') of (x', y') as `observe.lens` has them, the radial factor, and what that is
    divided by.
    """
    below = 1.0 + s * (lens[5] + s * (lens[6] + s * lens[7]))
    radial = (1.0 + s * (lens[0] + s * (lens[1] + s * lens[4]))) / below
    a = x * radial + 2.0 * lens[2] * x * y + lens[3] * (s + 2.0 * x * x)
    return a, y * radial + lens[2] * (s + 2.0 * y * y) + 2.0 * lens[3] * x * y, radial, below


@jit_inline
def _bent_vjp(x, y, s, lens, radial, below, ga, gb, to_numbers):
    """The cotangent of (x', y'), given that of (x'', y''); adds to that of the lens."""
    along = ga * x + gb * y
    above = along / below
    under = -along * radial / below
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
    gx = (
        ga * (radial + 2.0 * lens[2] * y + 4.0 * lens[3] * x)
        + gb * 2.0 * lens[3] * y
        + 2.0 * x * slope
    )
    return gx, gb * (radial + 4.0 * lens[2] * y + 2.0 * lens[3] * x) + ga * 2.0 * lens[
        2
    ] * x + 2.0 * y * slope
