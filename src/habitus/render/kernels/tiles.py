"""Compiled lists of faces by tiles of the image: which face is nearest at any point, and whether
one hides it.

Only tiles that are asked about need lists: those that edges run through at which an image may jump.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.raster import side, tiles_between
from habitus.render.kernels.vectors import PIXELS, greater, lesser, lowest, overlapping

CLOSE = 0.1
"""What counts as reaching a way beside an edge, in its distances from that: far more than float64
rounds.
"""
AROUND = 1.0
"""Pixels around an edge within which it may be asked what shows: its own pixels and a rounding
more.
"""


@jit_inline
def tiles_along(size, side):
    """How many tiles lie along a side of the image."""
    return (size + side - 1) // side


@jit_noalloc
def mark_tiles(screen, chosen, width, height, side, wanted):
    """Set `wanted` for the tiles within `AROUND` of the chosen edges, as far as these lie in the
    image.
    """
    columns = tiles_along(width, side)
    per_pixel = 1.0 / side
    for e in range(len(chosen.face)):
        p = chosen.tail[e]
        q = chosen.head[e]
        start = chosen.start[e]
        stop = chosen.stop[e]
        dx = screen[q, 0] - screen[p, 0]
        dy = screen[q, 1] - screen[p, 1]
        steps = 1 + int(greater(abs(dx), abs(dy)) * (stop - start) * per_pixel)
        step = (stop - start) / steps
        for n in range(steps):
            x0 = screen[p, 0] + (start + n * step) * dx
            y0 = screen[p, 1] + (start + n * step) * dy
            x1 = x0 + step * dx
            y1 = y0 + step * dy
            first, last = tiles_between(
                lesser(x0, x1) - AROUND, greater(x0, x1) + AROUND, width, per_pixel
            )
            top, bottom = tiles_between(
                lesser(y0, y1) - AROUND, greater(y0, y1) + AROUND, height, per_pixel
            )
            for row in range(top, bottom + 1):
                for column in range(first, last + 1):
                    wanted[row * columns + column] = True


@jit_noalloc
def choose_faces(facing, bounds, wanted, sums, shape, begin, end, chosen):
    """Write those of faces begin..end that may meet a wanted tile, ascending: how many, and how
    many tiles they meet.

    chosen (N, 4): face, the first of its tiles, and how many columns and rows of tiles it meets.
    sums (rows + 1, columns + 1): how many wanted tiles lie above and to the left of each tile's
    upper left corner. shape: width, height and the tiles' side.
    """
    width, height, pixels = shape
    columns = tiles_along(width, pixels)
    per_pixel = 1.0 / pixels
    count = 0
    tiles = 0
    for f in range(np.uintp(begin), np.uintp(end)):
        if facing[f] == 1 or facing[f] == -1:
            first, last = tiles_between(bounds[f, 0], bounds[f, 1], width, per_pixel)
            top, bottom = tiles_between(bounds[f, 2], bounds[f, 3], height, per_pixel)
            above = sums[np.uintp(top)]
            below = sums[np.uintp(bottom + 1)]
            left = np.uintp(first)
            right = np.uintp(last + 1)
            met = below[right] - below[left] - above[right] + above[left]
            chosen[count, 0], chosen[count, 1] = f, top * columns + first
            chosen[count, 2], chosen[count, 3] = last + 1 - first, bottom + 1 - top
            count += met > 0
            tiles += met
    return count, tiles


@jit_noalloc
def list_faces(bounds, chosen, wanted, tile_of, face_of, tiles):
    """Write chosen faces into the lists of their wanted tiles, ascending.

    tile_of, face_of: room for as many pairs as lists have entries. bounds: of each face, (F, 5).
    """
    starts, listed, to, width, _, pixels = tiles
    columns = tiles_along(width, pixels)
    count = 0
    starts[:] = 0
    for n in range(np.uintp(len(chosen))):
        f, first, across, down = chosen[n]
        for _ in range(down):
            for tile in range(first, first + across):
                if wanted[tile]:
                    tile_of[count], face_of[count] = tile, f
                    starts[tile + 1] += 1
                    count += 1
            first += columns
    for tile in range(len(wanted)):
        starts[tile + 1] += starts[tile]
    for n in range(
        np.uintp(count)
    ):  # each beginning goes on to the next list's, and all move up by one after that
        tile = np.uintp(tile_of[n])
        listed[np.uintp(starts[tile])] = face_of[n]
        starts[tile] += 1
    for n in range(np.uintp(count)):
        bound = bounds[np.uintp(listed[n])]
        to[0, n], to[1, n], to[2, n], to[3, n], to[4, n] = (
            bound[0],
            bound[1],
            bound[2],
            bound[3],
            bound[4],
        )
    for tile in range(len(wanted), 0, -1):
        starts[tile] = starts[tile - 1]
    starts[0] = 0


@jit_inline
def nearest_face(on_screen, tiles, x, y):
    """The nearest face over any point of the image and its w; -1 and 0 where there is none."""
    screen, inverse, faces, _ = on_screen
    starts, listed, bounds, _, _, _ = tiles
    tile = tile_at(tiles, x, y)
    found = -1
    best = 0.0
    end = starts[tile + 1]
    u = np.float32(x)
    v = np.float32(y)
    for first in range(starts[tile], end, PIXELS):
        left = overlapping(bounds, first, end - first, u, u, v, v, np.float32(best))
        while left:
            f = listed[np.uintp(first + lowest(left))]
            left &= left - 1
            w = _inverse_at(screen, inverse, faces, f, x, y)
            if w > best:
                found = f
                best = w
    return found, best


@jit_inline
def covered(on_screen, tiles, near, line, x, y, limit):
    """Whether any face over a point of a line has a greater w than `limit`, which is at least the
    line's least w.

    line: its box (u from and to, v from and to) and least w; a point, a step, and the `side` of the
    line through these that its points have. near: `NearFaces`, of the tile of the last query: far
    fewer than it has.
    """
    screen, inverse, faces, _ = on_screen
    tile = tile_at(tiles, x, y)
    if near.place[0] != tile:
        _gather(on_screen, tiles, tile, line, near)
    u = np.float32(x)
    v = np.float32(y)
    least = np.float32(limit)
    count = near.place[1]
    for first in range(0, count, PIXELS):
        left = overlapping(near.bounds, first, count - first, u, u, v, v, least)
        while left:
            if (
                _inverse_at(
                    screen, inverse, faces, near.faces[np.uintp(first + lowest(left))], x, y
                )
                > limit
            ):
                return True
            left &= left - 1
    return False


@jit_inline
def _gather(on_screen, tiles, tile, line, near):
    """Fill `near` with those of a tile's faces that may cover a line."""
    screen, _, faces, _ = on_screen
    starts, listed, bounds, _, _, _ = tiles
    low_x, high_x, low_y, high_y, front, x0, y0, dx, dy, there = line
    count = np.uintp(0)
    end = starts[tile + 1]
    for first in range(starts[tile], end, PIXELS):
        left = overlapping(bounds, first, end - first, low_x, high_x, low_y, high_y, front)
        while left:
            k = np.uintp(first + lowest(left))
            left &= left - 1
            a = faces[listed[k], 0]
            b = faces[listed[k], 1]
            c = faces[listed[k], 2]
            p = side(x0, y0, dx, dy, screen[a, 0], screen[a, 1])
            q = side(x0, y0, dx, dy, screen[b, 0], screen[b, 1])
            r = side(x0, y0, dx, dy, screen[c, 0], screen[c, 1])
            near.faces[count] = listed[k]
            for n in range(np.uintp(5)):
                near.bounds[n, count] = bounds[n, k]
            least = lesser(lesser(p, q), r)
            most = greater(greater(p, q), r)
            meets = (least <= there + CLOSE * abs(there)) & (most >= there - CLOSE * abs(there))
            count += np.uintp(meets)
    near.place[0], near.place[1] = tile, count


@jit_inline
def tile_at(tiles, x, y):
    """The tile of a point of the image, or the one next to a point beside it."""
    columns = tiles_along(tiles.width, tiles.side)
    per_pixel = 1.0 / tiles.side
    column = int(lesser(greater(x, 0.0), tiles.width - 0.5) * per_pixel)
    return int(lesser(greater(y, 0.0), tiles.height - 0.5) * per_pixel) * columns + column


@jit_inline
def _inverse_at(screen, inverse, faces, f, x, y):
    """A face's w at a point, 0 beside it."""
    n = np.uintp(f)
    a = np.uintp(faces[n, 0])
    b = np.uintp(faces[n, 1])
    c = np.uintp(faces[n, 2])
    ax = screen[a, 0] - x
    bx = screen[b, 0] - x
    cx = screen[c, 0] - x
    ay = screen[a, 1] - y
    by = screen[b, 1] - y
    cy = screen[c, 1] - y
    ea = by * cx - bx * cy
    eb = cy * ax - cx * ay
    ec = ay * bx - ax * by
    w = (ea * inverse[a] + eb * inverse[b] + ec * inverse[c]) / (ea + eb + ec)
    return (
        0.0 if (ea * eb < 0.0) | (ea * ec < 0.0) | (eb * ec < 0.0) else w
    )  # one branch, as each is hard to guess
