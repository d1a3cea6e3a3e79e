"""Compiled convex polygons: corners (M, 2), of which the first `size` count."""

from habitus.kernels.jit import jit_inline


@jit_inline
def clip(polygon, size, a, b, c, out):
    """The part of a convex polygon where a x + b y + c >= 0 (Sutherland and Hodgman 1974); its
    number of corners.
    """
    if size == 0:
        return 0
    count = 0
    px = polygon[size - 1, 0]
    py = polygon[size - 1, 1]
    before = a * px + b * py + c
    for k in range(size):
        qx = polygon[k, 0]
        qy = polygon[k, 1]
        here = a * qx + b * qy + c
        if (before < 0.0 and here > 0.0) or (before > 0.0 and here < 0.0):
            t = before / (before - here)
            out[count, 0], out[count, 1] = px + t * (qx - px), py + t * (qy - py)
            count += 1
        if here >= 0.0:
            out[count, 0], out[count, 1] = qx, qy
            count += 1
        px = qx
        py = qy
        before = here
    return count


@jit_inline
def copy(polygon, size, out):
    """Write a polygon to another place."""
    for k in range(size):
        out[k, 0], out[k, 1] = polygon[k, 0], polygon[k, 1]


@jit_inline
def value_at(lines, k, x, y):
    """The k-th of some numbers that are linear in x and y."""
    return lines[k, 0] * x + lines[k, 1] * y + lines[k, 2]


@jit_inline
def area_of(polygon, size):
    """The area of a convex polygon."""
    double = 0.0
    for k in range(1, size - 1):
        double += double_area(polygon, k)
    return 0.5 * abs(double)


@jit_inline
def double_area(polygon, k):
    """Twice the area of the k-th triangle of a polygon's fan."""
    ax = polygon[k, 0] - polygon[0, 0]
    ay = polygon[k, 1] - polygon[0, 1]
    bx = polygon[k + 1, 0] - polygon[0, 0]
    by = polygon[k + 1, 1] - polygon[0, 1]
    return ax * by - ay * bx
