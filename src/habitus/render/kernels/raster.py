"""Compiled rasteriser: the nearest triangle at each pixel's centre.

All works on the screen: u to the right, v down, in pixels; w = 1 / depth is linear there. An edge's value at a point is
computed from its two ends in one fixed order, so that the triangles on its two sides get exactly opposite numbers: no
holes, no double hits. `reference/faces.py` is the reference.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.vectors import PIXELS, draw_span

TILE = 8
"""Pixels along the side of a tile, of which each knows the farthest that shows in it."""
ROUNDING = 1e-6
"""What float32 may lose, relative."""
WIDEN = 0.01
"""Pixels by which bounds are wider than faces, more than float32 rounds."""


@jit_inline
def ordered_line(px, py, qx, qy):
    """The line through p and q: its first end (the upper, else the left), its step, and whether p -> q runs along."""
    if py < qy or (py == qy and px <= qx):
        return px, py, qx - px, qy - py, 1.0
    return qx, qy, px - qx, py - qy, -1.0


@jit_inline
def side(x0, y0, dx, dy, x, y):
    """Twice the area between a line and a point: positive to the right of its direction as seen on the screen."""
    return dx * (y - y0) - dy * (x - x0)


@jit_inline
def is_inside(px, py, qx, qy, turn, x, y):
    """Whether a point lies on the inside of the edge p -> q of a face whose area has the sign `turn`.

    On the edge itself, the top-left rule decides: as if the point lay a little to the right, and far less below.
    """
    x0, y0, dx, dy, along = ordered_line(px, py, qx, qy)
    value = turn * along * side(x0, y0, dx, dy, x, y)
    if value == 0.0:
        return turn * along < 0.0 if dy > 0.0 else turn * along > 0.0
    return value > 0.0


@jit_inline
def double_area(screen, a, b, c):
    """Twice a triangle's area on the screen; negative where it shows its front (counter-clockwise, v pointing down)."""
    x0, y0, dx, dy, along = ordered_line(screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1])
    return along * side(x0, y0, dx, dy, screen[c, 0], screen[c, 1])


@jit_noalloc
def invert_depths(screen, inverse):
    """1 / depth of vertices; 0 for those not finite or not in front of the camera, whose faces are not drawn."""
    for v in range(len(screen)):
        u, down, depth = screen[v, 0], screen[v, 1], screen[v, 2]
        usable = np.isfinite(u) and np.isfinite(down) and np.isfinite(depth) and depth > 0.0
        inverse[v] = 1.0 / depth if usable else 0.0


@jit_noalloc
def place_faces(on_screen, cull, width, height, begin, end, boxes):
    """Fill `on_screen.facing` and `boxes` for faces begin..end."""
    screen, inverse, faces, facing = on_screen
    for f in range(begin, end):
        facing[f] = 0
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
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
        tile, bound = boxes.tiles[f], boxes.bounds[f]
        tile[0], tile[1] = tiles_between(low_x, high_x, width, 1.0 / TILE)
        tile[2], tile[3] = tiles_between(low_y, high_y, height, 1.0 / TILE)
        bound[0], bound[1], bound[2], bound[3] = low_x - WIDEN, high_x + WIDEN, low_y - WIDEN, high_y + WIDEN
        bound[4] = max(inverse[a], inverse[b], inverse[c]) * (1.0 + ROUNDING)


@jit_inline
def extent(screen, a, b, c):
    """A face's least and greatest u, and v."""
    low_x = min(screen[a, 0], screen[b, 0], screen[c, 0])
    high_x = max(screen[a, 0], screen[b, 0], screen[c, 0])
    low_y = min(screen[a, 1], screen[b, 1], screen[c, 1])
    high_y = max(screen[a, 1], screen[b, 1], screen[c, 1])
    return low_x, high_x, low_y, high_y


@jit_inline
def tiles_between(low, high, size, tiles_per_pixel):
    """The first and the last tile that an interval meets in an image of that size; the tiles' side is a power of 2."""
    last = int(min(high, size - 0.5) * tiles_per_pixel)
    return min(int(max(low, 0.0) * tiles_per_pixel), last), last


@jit_noalloc
def draw_rows(on_screen, boxes, begin, end, ids, nearest, farthest):
    """The nearest face at each pixel centre of rows of tiles begin..end; of equally near ones the first.

    Faces that show their front come first: those of a closed mesh hide most others, tile by tile.
    nearest: the largest w at each pixel of the image; farthest: room for the smallest of each tile of the rows.
    """
    screen, inverse, faces, facing = on_screen
    top, bottom, width = begin * TILE, min(end * TILE, ids.shape[0]), ids.shape[1]
    for y in range(np.uintp(top), np.uintp(bottom)):
        for x in range(np.uintp(width)):
            nearest[y, x], ids[y, x] = 0.0, -1
    for lies in (-1, 1):
        for f in range(len(faces)):
            meets = facing[f] == lies and boxes.tiles[f, 2] < end and boxes.tiles[f, 3] >= begin
            if meets and (lies < 0 or not _is_hidden(boxes, f, begin, end, farthest)):
                _draw_face(screen, inverse, faces, f, top, bottom, width, nearest, ids)
        if lies < 0:
            _find_farthest(nearest, top, bottom, farthest)


@jit_inline
def _find_farthest(nearest, top, bottom, farthest):
    """The smallest w of each tile of rows top..bottom of pixels."""
    for row in range(farthest.shape[0]):
        for column in range(farthest.shape[1]):
            least = np.inf
            for y in range(top + row * TILE, min(top + (row + 1) * TILE, bottom)):
                for x in range(column * TILE, min((column + 1) * TILE, nearest.shape[1])):
                    least = min(least, nearest[np.uintp(y), np.uintp(x)])
            farthest[row, column] = least


@jit_inline
def _is_hidden(boxes, f, begin, end, farthest):
    """Whether all that is seen in the tiles of a face is nearer than its nearest corner."""
    tile, front = boxes.tiles[f], boxes.bounds[f, 4]
    for row in range(max(tile[2], begin), min(tile[3] + 1, end)):
        for column in range(tile[0], tile[1] + 1):
            if farthest[row - begin, column] <= front:
                return False
    return True


@jit_inline
def _draw_face(screen, inverse, faces, f, top, bottom, width, nearest, ids):
    """One face into rows top..bottom, each between the two edges that the row meets.

    A row belongs to an edge from its upper end on until before its lower one, and a pixel to what begins at or left of
    its centre: this is the top-left rule.
    """
    a, b, c = _downwards(screen, np.uintp(faces[f, 0]), np.uintp(faces[f, 1]), np.uintp(faces[f, 2]))
    ax, ay, bx, by, cx, cy = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
    first = max(top, int(np.ceil(max(ay, float(top)) - 0.5)))
    last = min(bottom, int(np.ceil(min(cy, float(bottom)) - 0.5)))
    if first >= last:
        return
    x0, y0, slope = _slant(ax, ay, cx, cy)
    x1, y1, upper = _slant(ax, ay, bx, by)
    x2, y2, lower = _slant(bx, by, cx, cy)
    scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    across = ((inverse[b] - inverse[a]) * (cy - ay) - (inverse[c] - inverse[a]) * (by - ay)) * scale
    down = ((inverse[c] - inverse[a]) * (bx - ax) - (inverse[b] - inverse[a]) * (cx - ax)) * scale
    for y in range(first, last):
        v = y + 0.5
        long = x0 + (v - y0) * slope
        short = x1 + (v - y1) * upper if v < by else x2 + (v - y2) * lower
        begin = int(np.ceil(max(min(long, short), 0.5) - 0.5))
        end = int(np.ceil(min(max(long, short), width + 0.5) - 0.5))
        start = inverse[a] + (v - ay) * down + (0.5 - ax) * across
        for x in range(begin, end, PIXELS):
            draw_span(nearest, ids, y * width + x, float(x), end - x, start, across, np.int32(f))


@jit_inline
def _downwards(screen, a, b, c):
    """A face's corners from the top down; without branches, as half of them would be guessed wrong."""
    swap = screen[b, 1] < screen[a, 1]
    a, b = (b, a) if swap else (a, b)
    swap = screen[c, 1] < screen[a, 1]
    a, c = (c, a) if swap else (a, c)
    swap = screen[c, 1] < screen[b, 1]
    return (a, c, b) if swap else (a, b, c)


@jit_inline
def _slant(px, py, qx, qy):
    """A point of the line through p and q and its step to the right a row, the same from whichever side it is asked."""
    swap = (qy < py) | ((qy == py) & (qx < px))  # as `ordered_line` has it
    x0, y0 = (qx, qy) if swap else (px, py)
    dx, dy = (px - qx, py - qy) if swap else (qx - px, qy - py)
    return x0, y0, dx / dy if dy > 0.0 else 0.0
