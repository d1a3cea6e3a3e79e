"""Compiled lists of faces by tiles of the image: which face is nearest at any point, and whether one hides it.

Only tiles that are asked about need lists: those that edges run through at which an image may jump.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.raster import ROUNDING, extent, side, tiles_between

WIDEN = 0.01
"""Pixels by which bounds are wider than faces, more than float32 rounds."""
CLOSE = 0.1
"""What counts as reaching a way beside an edge, in its distances from that: far more than float64 rounds."""
AROUND = 1.0
"""Pixels around an edge within which it may be asked what shows: its own pixels and a rounding more."""


@jit_inline
def tiles_along(size, side):
    """How many tiles lie along a side of the image."""
    return (size + side - 1) // side


@jit_noalloc
def mark_tiles(screen, edges, faces, chosen, width, height, side, wanted, larger, times):
    """Set `wanted` for the tiles within `AROUND` of the chosen edges, as far as these lie in the image.

    Set `larger` for tiles of so many `times` the side, too.
    """
    columns, larger_columns, per_pixel = tiles_along(width, side), tiles_along(width, side * times), 1.0 / side
    for e in range(len(chosen.entry)):
        f, corner = edges.face[chosen.entry[e]], edges.corner[chosen.entry[e]]
        p, q = faces[f, corner], faces[f, (corner + 1) % 3]
        start, stop = chosen.start[e], chosen.stop[e]
        dx, dy = screen[q, 0] - screen[p, 0], screen[q, 1] - screen[p, 1]
        steps = 1 + int(max(abs(dx), abs(dy)) * (stop - start) * per_pixel)
        step = (stop - start) / steps
        for n in range(steps):
            x0, y0 = screen[p, 0] + (start + n * step) * dx, screen[p, 1] + (start + n * step) * dy
            x1, y1 = x0 + step * dx, y0 + step * dy
            first, last = tiles_between(min(x0, x1) - AROUND, max(x0, x1) + AROUND, width, per_pixel)
            top, bottom = tiles_between(min(y0, y1) - AROUND, max(y0, y1) + AROUND, height, per_pixel)
            for row in range(top, bottom + 1):
                for column in range(first, last + 1):
                    wanted[row * columns + column] = True
                    larger[row // times * larger_columns + column // times] = True


@jit_noalloc
def choose_faces(facing, boxes, wanted, columns, chosen):
    """Write the faces whose boxes hold a wanted tile, ascending, and give their number."""
    count = 0
    for f in range(len(facing)):
        if facing[f] == 1 or facing[f] == -1:
            meets = False
            for row in range(boxes[f, 2], boxes[f, 3] + 1):
                for column in range(boxes[f, 0], boxes[f, 1] + 1):
                    meets |= wanted[row * columns + column]
            chosen[count] = f
            count += meets
    return count


@jit_noalloc
def count_faces(on_screen, chosen, wanted, width, height, side, begin, end, counts):
    """Count the chosen faces begin..end that meet each wanted tile."""
    screen, _, faces, _ = on_screen
    columns, per_pixel = tiles_along(width, side), 1.0 / side
    for n in range(begin, end):
        f = chosen[n]
        low_x, high_x, low_y, high_y = extent(screen, faces[f, 0], faces[f, 1], faces[f, 2])
        first, last = tiles_between(low_x, high_x, width, per_pixel)
        top, bottom = tiles_between(low_y, high_y, height, per_pixel)
        for row in range(top, bottom + 1):
            for column in range(first, last + 1):
                counts[row * columns + column] += wanted[row * columns + column]


@jit_noalloc
def list_faces(on_screen, tiles, chosen, wanted, begin, end, cursor):
    """Write chosen faces into the lists of their wanted tiles, in order; `cursor` says where each list goes on.

    Beside each entry go the face's box on the screen and its largest w, a little widened: most queries need not look
    further.
    """
    screen, inverse, faces, _ = on_screen
    _, listed, bounds, width, height, side = tiles
    columns, per_pixel = tiles_along(width, side), 1.0 / side
    for n in range(begin, end):
        f = chosen[n]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        low_x, high_x, low_y, high_y = extent(screen, a, b, c)
        front = max(inverse[a], inverse[b], inverse[c]) * (1.0 + ROUNDING)
        first, last = tiles_between(low_x, high_x, width, per_pixel)
        top, bottom = tiles_between(low_y, high_y, height, per_pixel)
        for row in range(top, bottom + 1):
            for column in range(first, last + 1):
                tile = row * columns + column
                if wanted[tile]:
                    entry = bounds[cursor[tile]]
                    entry[0], entry[1], entry[2], entry[3] = (
                        low_x - WIDEN,
                        high_x + WIDEN,
                        low_y - WIDEN,
                        high_y + WIDEN,
                    )
                    entry[4], listed[cursor[tile]] = front, f
                    cursor[tile] += 1


@jit_inline
def nearest_face(on_screen, tiles, x, y):
    """The nearest face over any point of the image and its w; -1 and 0 where there is none."""
    screen, inverse, faces, _ = on_screen
    starts, listed, bounds, _, _, _ = tiles
    tile = tile_at(tiles, x, y)
    found, best = -1, 0.0
    u, v = np.float32(x), np.float32(y)
    for k in range(starts[tile], starts[tile + 1]):
        if _may_cover(bounds, k, u, v, np.float32(best)):
            w = _inverse_at(screen, inverse, faces, listed[k], x, y)
            if w > best:
                found, best = listed[k], w
    return found, best


@jit_inline
def covered(on_screen, tiles, near, line, x, y, limit):
    """Whether any face over a point of a line has a greater w than `limit`, which is at least the line's least w.

    line: its box (u from and to, v from and to) and least w; a point, a step, and the `side` of the line through these
    that its points have. near: workspace for the tile of the last query, -1 for none, and its entries that may cover
    the line: far fewer than it has.
    """
    screen, inverse, faces, _ = on_screen
    _, listed, bounds, _, _, _ = tiles
    tile = tile_at(tiles, x, y)
    if near[0] != tile:
        _gather(on_screen, tiles, tile, line, near)
    u, v, least = np.float32(x), np.float32(y), np.float32(limit)
    for n in range(np.uintp(2), np.uintp(near[1])):
        k = np.uintp(near[n])
        if _may_cover(bounds, k, u, v, least) and _inverse_at(screen, inverse, faces, listed[k], x, y) > limit:
            return True
    return False


@jit_inline
def _gather(on_screen, tiles, tile, line, near):
    """Write a tile, the end of the list that follows, and that list: the tile's entries that may cover a line."""
    screen, _, faces, _ = on_screen
    starts, listed, bounds, _, _, _ = tiles
    low_x, high_x, low_y, high_y, least, x0, y0, dx, dy, there = line
    end = np.uintp(2)
    for k in range(np.uintp(starts[tile]), np.uintp(starts[tile + 1])):
        meets = (bounds[k, 0] <= high_x) & (bounds[k, 1] >= low_x) & (bounds[k, 2] <= high_y) & (bounds[k, 3] >= low_y)
        if meets & (bounds[k, 4] >= least):
            a, b, c = faces[listed[k], 0], faces[listed[k], 1], faces[listed[k], 2]
            p = side(x0, y0, dx, dy, screen[a, 0], screen[a, 1])
            q = side(x0, y0, dx, dy, screen[b, 0], screen[b, 1])
            r = side(x0, y0, dx, dy, screen[c, 0], screen[c, 1])
            near[end] = k
            end += np.uintp((min(p, q, r) <= there + CLOSE * abs(there)) & (max(p, q, r) >= there - CLOSE * abs(there)))
    near[0], near[1] = tile, end


@jit_inline
def tile_at(tiles, x, y):
    """The tile of a point of the image, or the one next to a point beside it."""
    columns, per_pixel = tiles_along(tiles.width, tiles.side), 1.0 / tiles.side
    column = int(min(max(x, 0.0), tiles.width - 0.5) * per_pixel)
    return int(min(max(y, 0.0), tiles.height - 0.5) * per_pixel) * columns + column


@jit_inline
def _may_cover(bounds, k, x, y, limit):
    """Whether a listed face's box holds a point and the face reaches beyond w = limit."""
    inside = (bounds[k, 0] <= x) & (bounds[k, 1] >= x) & (bounds[k, 2] <= y) & (bounds[k, 3] >= y)
    return inside & (bounds[k, 4] >= limit)


@jit_inline
def _inverse_at(screen, inverse, faces, f, x, y):
    """A face's w at a point, 0 beside it."""
    n = np.uintp(f)
    a, b, c = np.uintp(faces[n, 0]), np.uintp(faces[n, 1]), np.uintp(faces[n, 2])
    ax, bx, cx = screen[a, 0] - x, screen[b, 0] - x, screen[c, 0] - x
    ay, by, cy = screen[a, 1] - y, screen[b, 1] - y, screen[c, 1] - y
    ea, eb, ec = by * cx - bx * cy, cy * ax - cx * ay, ay * bx - ax * by
    w = (ea * inverse[a] + eb * inverse[b] + ec * inverse[c]) / (ea + eb + ec)
    return 0.0 if (ea * eb < 0.0) | (ea * ec < 0.0) | (eb * ec < 0.0) else w  # one branch, as each is hard to guess
