"""The area of a pixel behind an edge fragment, as seen from the pixel's centre."""

from habitus.kernels.jit import jit_inline
from habitus.render.kernels.vectors import lesser


@jit_inline
def shadow(ax, ay, bx, by):
    """The area of the unit square around 0 that lies behind the fragment from a to b, as seen from
    0.

    A wedge at the centre covers a quarter of the way that it spans along the square's border; the
    triangle before the fragment comes off.
    """
    way = abs(_along_border(ax, ay) - _along_border(bx, by))
    return 0.25 * lesser(way, 4.0 - way) - 0.5 * abs(ax * by - ay * bx)


@jit_inline
def _along_border(x, y):
    """Where a direction meets the unit square's border, as the way along it, from 0 to 4; no
    direction is to the left: by the top-left rule a centre lies a little to the right of what it
    touches.
    """
    if abs(x) >= abs(y):
        return 2.5 if x == 0.0 else (0.5 if x > 0.0 else 2.5) + 0.5 * y / x
    return (1.5 if y > 0.0 else 3.5) - 0.5 * x / y
