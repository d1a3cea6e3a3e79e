"""Compiled rasteriser: the nearest triangle at each pixel's centre.

All works on the screen: u to the right, v down, in pixels; w = 1 / depth is linear there. An edge's
value at a point is computed from its two ends in one fixed order, so that the triangles on its two
sides get exactly opposite numbers: no holes, no double hits. `reference/faces.py` is the reference.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.vectors import PIXELS, draw_span, greater, lesser

TILE = 8
"""Pixels along the side of a tile, of which each knows the farthest that shows in it."""
ROUNDING = 1e-6
"""What float32 may lose, relative."""
WIDEN = 0.01
"""Pixels by which bounds are wider than faces, more than float32 rounds."""


@jit_inline
def ordered_line(px, py, qx, qy):
    """The line through p and q: its first end (the upper, else the left), its step, and whether p
    -> q runs along.
    """
    if py < qy or (py == qy and px <= qx):
        return px, py, qx - px, qy - py, 1.0
    return qx, qy, px - qx, py - qy, -1.0


@jit_inline
def side(x0, y0, dx, dy, x, y):
    """Twice the area between a line and a point: positive to the right of its direction as seen on
    the screen.
    """
    return dx * (y - y0) - dy * (x - x0)


@jit_inline
def is_inside(px, py, qx, qy, turn, x, y):
    """Whether a point lies on the inside of the edge p -> q of a face whose area has the sign
    `turn`.

    On the edge itself, the top-left rule decides: as if the point lay a little to the right, and
    far less below.
    """
    x0, y0, dx, dy, along = ordered_line(px, py, qx, qy)
    value = turn * along * side(x0, y0, dx, dy, x, y)
    if value == 0.0:
        return turn * along < 0.0 if dy > 0.0 else turn * along > 0.0
    return value > 0.0


@jit_inline
def double_area(screen, a, b, c):
    """Twice a triangle's area on the screen; negative where it shows its front (counter-clockwise,
    v pointing down).
    """
    x0, y0, dx, dy, along = ordered_line(screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1])
    return along * side(x0, y0, dx, dy, screen[c, 0], screen[c, 1])


@jit_noalloc
def invert_depths(screen, inverse):
    """1 / depth of vertices; 0 for those not finite or not in front of the camera, whose faces are
    not drawn.
    """
    for v in range(len(screen)):
        u = screen[v, 0]
        down = screen[v, 1]
        depth = screen[v, 2]
        usable = np.isfinite(u) and np.isfinite(down) and np.isfinite(depth) and depth > 0.0
        inverse[v] = 1.0 / depth if usable else 0.0


@jit_noalloc
def place_faces(on_screen, cull, width, height, begin, end, bounds):
    """Fill `on_screen.facing` and `bounds` (F, 5), float32, for faces begin..end.

    bounds, of faces in the image: u from and to, v from and to, and the largest w, a little
    widened.
    """
    screen, inverse, faces, facing = on_screen
    for f in range(begin, end):
        facing[f] = 0
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        if inverse[a] == 0.0 or inverse[b] == 0.0 or inverse[c] == 0.0:
            continue
        area = double_area(screen, a, b, c)
        if area == 0.0 or (cull and area > 0.0):
            continue
        low_x, high_x, low_y, high_y = extent(screen, a, b, c)
        if high_x < 0.0 or low_x > width or high_y < 0.0 or low_y > height:
            facing[f] = 2 if area > 0.0 else -2
            continue
        facing[f] = 1 if area > 0.0 else -1
        bound = bounds[f]
        bound[0], bound[1], bound[2], bound[3] = (
            low_x - WIDEN,
            high_x + WIDEN,
            low_y - WIDEN,
            high_y + WIDEN,
        )
        bound[4] = greater(greater(inverse[a], inverse[b]), inverse[c]) * (1.0 + ROUNDING)


@jit_inline
def extent(screen, a, b, c):
    """A face's least and greatest u, and v."""
    low_x = lesser(lesser(screen[a, 0], screen[b, 0]), screen[c, 0])
    high_x = greater(greater(screen[a, 0], screen[b, 0]), screen[c, 0])
    low_y = lesser(lesser(screen[a, 1], screen[b, 1]), screen[c, 1])
    high_y = greater(greater(screen[a, 1], screen[b, 1]), screen[c, 1])
    return low_x, high_x, low_y, high_y


@jit_inline
def tiles_between(low, high, size, tiles_per_pixel):
    """The first and the last tile that an interval meets in an image of that size; the tiles' side
    is a power of 2.
    """
    last = int(lesser(high, size - 0.5) * tiles_per_pixel)
    return lesser(int(greater(low, 0.0) * tiles_per_pixel), last), last


@jit_noalloc
def draw_rows(on_screen, bounds, begin, end, ids, nearest, farthest):
    """The nearest face at each pixel centre of rows of tiles begin..end; of equally near ones the
    first.

    Faces that show their front come first: those of a closed mesh hide most others, tile by tile.
    nearest: the largest w at each pixel of the image; farthest: room for the smallest of each tile
    of the rows.
    """
    screen, inverse, faces, facing = on_screen
    top = begin * TILE
    bottom = lesser(end * TILE, ids.shape[0])
    width = ids.shape[1]
    for y in range(np.uintp(top), np.uintp(bottom)):
        for x in range(np.uintp(width)):
            nearest[y, x], ids[y, x] = 0.0, -1
    for lies in (-1, 1):
        for f in range(len(faces)):
            meets = facing[f] == lies and bounds[f, 2] < bottom and bounds[f, 3] >= top
            if meets and (
                lies < 0 or not _is_hidden(bounds[f], begin, width, ids.shape[0], farthest)
            ):
                _draw_face(screen, inverse, faces, f, top, bottom, width, nearest, ids)
        if lies < 0:
            _find_farthest(nearest, top, bottom, farthest)


@jit_inline
def _find_farthest(nearest, top, bottom, farthest):
    """The smallest w of each tile of rows top..bottom of pixels."""
    for row in range(farthest.shape[0]):
        for column in range(farthest.shape[1]):
            least = np.inf
            for y in range(top + row * TILE, lesser(top + (row + 1) * TILE, bottom)):
                for x in range(column * TILE, lesser((column + 1) * TILE, nearest.shape[1])):
                    least = lesser(least, nearest[np.uintp(y), np.uintp(x)])
            farthest[row, column] = least


@jit_inline
def _is_hidden(bound, begin, width, height, farthest):
    """Whether all that is seen in the tiles of a face, from row `begin` on, is nearer than its
    nearest corner.
    """
    first, last = tiles_between(bound[0], bound[1], width, 1.0 / TILE)
    top, bottom = tiles_between(bound[2], bound[3], height, 1.0 / TILE)
    for row in range(greater(top - begin, 0), lesser(bottom - begin + 1, len(farthest))):
        for column in range(first, last + 1):
            if farthest[row, column] <= bound[4]:
                return False
    return True


@jit_inline
def _draw_face(screen, inverse, faces, f, top, bottom, width, nearest, ids):
    """One face into rows top..bottom, each between the two edges that the row meets.

    A row belongs to an edge from its upper end on until before its lower one, and a pixel to what
    begins at or left of its centre: this is the top-left rule.
    """
    a, b, c = _downwards(
        screen, np.uintp(faces[f, 0]), np.uintp(faces[f, 1]), np.uintp(faces[f, 2])
    )
    ax = screen[a, 0]
    ay = screen[a, 1]
    bx = screen[b, 0]
    by = screen[b, 1]
    cx = screen[c, 0]
    cy = screen[c, 1]
    first = _row_from(ay, top, bottom)
    turn = _row_from(by, top, bottom)
    last = _row_from(cy, top, bottom)
    if first >= last:
        return
    scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    across = ((inverse[b] - inverse[a]) * (cy - ay) - (inverse[c] - inverse[a]) * (by - ay)) * scale
    down = ((inverse[c] - inverse[a]) * (bx - ax) - (inverse[b] - inverse[a]) * (cx - ax)) * scale
    slope = (cx - ax) / (cy - ay)
    for part in range(2):
        begin, until = (first, turn) if part == 0 else (turn, last)
        x0, y0, slant = (
            (ax, ay, (bx - ax) / (by - ay)) if part == 0 else (bx, by, (cx - bx) / (cy - by))
        )
        for y in range(begin, until):
            v = y + 0.5
            long = ax + (v - ay) * slope
            short = x0 + (v - y0) * slant
            left = int(np.ceil(greater(lesser(long, short), 0.5) - 0.5))
            right = int(np.ceil(lesser(greater(long, short), width + 0.5) - 0.5))
            start = inverse[a] + (v - ay) * down + (0.5 - ax) * across
            # Whether a row of a small face has a pixel at all would be guessed wrong half of the
            # time: none draws none.
            draw_span(
                nearest,
                ids,
                y * width + left,
                float(left),
                right - left,
                start,
                across,
                np.int32(f),
            )
            for x in range(left + PIXELS, right, PIXELS):
                draw_span(
                    nearest, ids, y * width + x, float(x), right - x, start, across, np.int32(f)
                )


@jit_inline
def _row_from(y, top, bottom):
    """The first row of top..bottom whose centre is not above y."""
    return int(np.ceil(lesser(greater(y, float(top)), float(bottom)) - 0.5))


@jit_inline
def _downwards(screen, a, b, c):
    """A face's corners from the top down; without branches, as half of them would be guessed
    wrong.
    """
    swap = screen[b, 1] < screen[a, 1]
    a, b = (b, a) if swap else (a, b)
    swap = screen[c, 1] < screen[a, 1]
    a, c = (c, a) if swap else (a, c)
    swap = screen[c, 1] < screen[b, 1]
    return (a, c, b) if swap else (a, b, c)
