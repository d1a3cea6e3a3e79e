"""Compiled areas: what of each face shows in a pixel, as convex polygons; only their areas and
centroids are kept.

A face is clipped to the pixel, and from what is left is cut away where another one covers it and is
nearer: a convex region, also where surfaces pass through each other, as 1 / depth is linear on the
screen.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.polygons import area_of, clip, copy, double_area, value_at
from habitus.render.kernels.tiles import nearest_face, tile_at

CORNERS, PIECES = 16, 48
"""Room for a polygon's corners (a square, cut seven times at most) and for the pieces of a triangle
in a pixel.
"""
EMPTY = 1e-12
"""Square pixels below which nothing is left."""
WHOLE = 1.0 - 1e-9
"""From this share on a pixel counts as covered."""
TIE = 1e-9
"""Of surfaces as near as this, relative, the first in the list of faces shows."""
BESIDE = 1e-5
"""How far outside an edge the surface behind it is looked up, in pixels."""


@jit_noalloc
def choose_pixels(ids, crossed, begin, end, chosen):
    """Which pixels of rows begin..end may show more than one face: those an edge fragment crosses,
    and those of a face that not all neighbours show (a face that all show covers the pixel, as it
    is convex).
    """
    height, width = ids.shape
    for y in range(begin, end):
        for x in range(width):
            f = ids[y, x]
            alike = True
            for row in range(max(y - 1, 0), min(y + 2, height)):
                for column in range(max(x - 1, 0), min(x + 2, width)):
                    alike = alike and ids[row, column] == f
            at_border = y == 0 or x == 0 or y == height - 1 or x == width - 1
            chosen[y, x] = crossed[y, x] or (f >= 0 and (at_border or not alike))


@jit_noalloc
def find_areas(on_screen, tiles, ids, inverse, pixels, begin, end, room, found, crossing):
    """What shows in pixels begin..end, from `found`'s beginning on: the pixel stopped at for want
    of room, and a count.

    A pixel that one face fills is left out. inverse: w at pixels' centres. crossing: set where
    surfaces pass through each other. room: `AreaRoom`. Faces behind all that the neighbours'
    centres show are looked at only where a pixel is not covered without them.
    """
    count = 0
    width = tiles.width
    for n in range(begin, end):
        column = pixels[n] % width
        row = pixels[n] // width
        least = _farthest(inverse, column, row)
        if count + len(room.order) + 1 > len(found.pixel):
            return n, count
        size = _gather(on_screen, tiles, column, row, least, room)
        covered, after = _show_all(room, size, pixels[n], column, row, count, found, crossing)
        if covered < WHOLE and least > 0.0:
            size = _gather(on_screen, tiles, column, row, np.float32(0.0), room)
            covered, after = _show_all(room, size, pixels[n], column, row, count, found, crossing)
        if covered < WHOLE:
            found.pixel[after], found.face[after], found.area[after] = pixels[n], -1, 1.0 - covered
            found.point[after, 0], found.point[after, 1] = column + 0.5, row + 0.5
            after += 1
        elif after == count + 1 and found.face[count] == ids[row, column]:
            continue
        count = after
    return end, count


@jit_inline
def _farthest(inverse, column, row):
    """A w that all reach that may show in a pixel, from those at its and its neighbours' centres; 0
    for any.
    """
    low = np.inf
    high = 0.0
    for y in range(max(row - 1, 0), min(row + 2, inverse.shape[0])):
        for x in range(max(column - 1, 0), min(column + 2, inverse.shape[1])):
            low = min(low, inverse[y, x])
            high = max(high, inverse[y, x])
    return np.float32(max(2.0 * low - high, 0.0))


@jit_inline
def _show_all(room, size, pixel, column, row, count, found, crossing):
    """Write what shows in a pixel to `found` from `count` on: the area covered, and where the
    entries end.
    """
    covered = 0.0
    for k in range(size):
        if covered >= WHOLE:
            break
        area, x, y = _sum(room, _show(room, size, k, pixel, crossing))
        if area > EMPTY:
            found.pixel[count], found.face[count], found.area[count] = (
                pixel,
                room.face[room.order[k]],
                area,
            )
            found.point[count, 0], found.point[count, 1] = column + x / area, row + y / area
            covered = covered + area
            count = count + 1
    return covered, count


@jit_noalloc
def look_beside(on_screen, tiles, found, begin, end, sides):
    """The faces and points right beside the middles of edge fragments begin..end: there the image's
    jump is taken.
    """
    screen = on_screen.screen
    for n in range(begin, end):
        tail, head, (x, y) = found.tail[n], found.head[n], found.middle[n]
        dx = screen[head, 0] - screen[tail, 0]
        dy = screen[head, 1] - screen[tail, 1]
        scale = BESIDE * found.outward[n] / np.sqrt(dx * dx + dy * dy)
        right = scale * dy
        down = -scale * dx
        sides.inner_point[n, 0], sides.inner_point[n, 1] = x - right, y - down
        sides.outer_point[n, 0], sides.outer_point[n, 1] = x + right, y + down
        sides.inner_face[n] = nearest_face(on_screen, tiles, x - right, y - down)[0]
        sides.outer_face[n] = nearest_face(on_screen, tiles, x + right, y + down)[0]


@jit_inline
def _gather(on_screen, tiles, column, row, least, room):
    """Fill `room` with a pixel's faces that reach w = least, the nearest first, in its coordinates;
    how many.
    """
    starts, listed, bounds, _, _, _ = tiles
    tile = tile_at(tiles, float(column), float(row))
    left = np.float32(column)
    top = np.float32(row)
    size = 0
    right = left + np.float32(1.0)
    bottom = top + np.float32(1.0)
    for k in range(starts[tile], starts[tile + 1]):
        beside = (
            (bounds[0, k] > right)
            | (bounds[1, k] < left)
            | (bounds[2, k] > bottom)
            | (bounds[3, k] < top)
        )
        if beside | (bounds[4, k] < least):
            continue
        lines = room.lines[size]
        if not _set_lines(on_screen, listed[k], column, row, lines):
            continue
        corners = _clip_to_square(lines, room, size)
        if area_of(room.polygon[size], corners) <= EMPTY:
            continue
        low = np.inf
        high = 0.0
        mean = 0.0
        for c in range(corners):
            w = value_at(lines, 3, room.polygon[size, c, 0], room.polygon[size, c, 1])
            low = min(low, w)
            high = max(high, w)
            mean = mean + w
        room.face[size], room.corners[size], mean = listed[k], corners, mean / corners
        room.low[size], room.high[size], room.mean[size] = low, high, mean
        place = size
        while place > 0 and room.mean[room.order[place - 1]] < mean:
            room.order[place] = room.order[place - 1]
            place -= 1
        room.order[place] = size
        size += 1
    return size


@jit_inline
def _set_lines(on_screen, f, column, row, out):
    """A face's shares l_a, l_b, l_c and its w as a x + b y + c in the pixel's coordinates; False if
    it has no area.
    """
    screen, inverse, faces, _ = on_screen
    a = faces[f, 0]
    b = faces[f, 1]
    c = faces[f, 2]
    ax = screen[a, 0] - column
    ay = screen[a, 1] - row
    bx = screen[b, 0] - column
    by = screen[b, 1] - row
    cx = screen[c, 0] - column
    cy = screen[c, 1] - row
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area == 0.0:
        return False
    scale = 1.0 / area
    out[0, 0], out[0, 1], out[0, 2] = (
        (by - cy) * scale,
        (cx - bx) * scale,
        (bx * cy - cx * by) * scale,
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        (cy - ay) * scale,
        (ax - cx) * scale,
        (cx * ay - ax * cy) * scale,
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        (ay - by) * scale,
        (bx - ax) * scale,
        (ax * by - bx * ay) * scale,
    )
    for k in range(3):
        out[3, k] = out[0, k] * inverse[a] + out[1, k] * inverse[b] + out[2, k] * inverse[c]
    return True


@jit_inline
def _clip_to_square(lines, room, n):
    """Write the part of the pixel that a face covers to `room.polygon[n]`; its number of
    corners.
    """
    for k in range(3):  # most of a box's pixels lie beside a side of the face
        best = lines[k, 2] + max(lines[k, 0], 0.0) + max(lines[k, 1], 0.0)
        if best <= 0.0:
            return 0
    polygon = room.first
    size = 4
    polygon[0, 0], polygon[0, 1], polygon[1, 0], polygon[1, 1] = 0.0, 0.0, 1.0, 0.0
    polygon[2, 0], polygon[2, 1], polygon[3, 0], polygon[3, 1] = 1.0, 1.0, 0.0, 1.0
    size = clip(polygon, size, lines[0, 0], lines[0, 1], lines[0, 2], room.second)
    size = clip(room.second, size, lines[1, 0], lines[1, 1], lines[1, 2], room.first)
    return clip(room.first, size, lines[2, 0], lines[2, 1], lines[2, 2], room.polygon[n])


@jit_inline
def _show(room, size, k, pixel, crossing):
    """Write what shows of the k-th nearest face to `room.pieces`; how many pieces."""
    own = room.order[k]
    copy(room.polygon[own], room.corners[own], room.pieces[0])
    room.sizes[0], count = room.corners[own], 1
    for other in range(size):
        n = room.order[other]
        if n == own or room.high[n] * (1.0 + TIE) < room.low[own] or _apart(room, own, n):
            continue
        mine = room.lines[own]
        its = room.lines[n]
        bias = TIE * room.mean[own]
        a = its[3, 0] - mine[3, 0]
        b = its[3, 1] - mine[3, 1]
        c = its[3, 2] - mine[3, 2] + (bias if room.face[n] < room.face[own] else -bias)
        count, meets = _cut_away(room, count, its, a, b, c)
        if meets and room.low[n] < room.high[own] and _crosses(room, own, n, a, b, c):
            crossing[pixel] = True
    return count


@jit_inline
def _apart(room, own, n):
    """Whether one side of face n parts the two faces' polygons."""
    for k in range(3):
        highest = -np.inf
        for c in range(room.corners[own]):
            highest = max(
                highest,
                value_at(room.lines[n], k, room.polygon[own, c, 0], room.polygon[own, c, 1]),
            )
        if highest <= 1e-9:
            return True
    return False


@jit_inline
def _crosses(room, own, n, a, b, c):
    """Whether, where two faces overlap, now one and now the other is nearer."""
    size = room.corners[own]
    copy(room.polygon[own], size, room.first)
    for k in range(3):
        line = room.lines[n, k]
        size = clip(room.first, size, line[0], line[1], line[2], room.second)
        copy(room.second, size, room.first)
    nearer = area_of(room.second, clip(room.first, size, a, b, c, room.second))
    return nearer > 1e-6 and area_of(room.first, size) - nearer > 1e-6


@jit_inline
def _cut_away(room, count, lines, a, b, c):
    """Take from pieces what lies on a face (its lines) where a x + b y + c > 0; how many are left,
    if any was cut.
    """
    piece = 0
    meets = False
    while piece < count:
        size = room.sizes[piece]
        copy(room.pieces[piece], size, room.first)
        for k in range(4):
            la, lb, lc = (a, b, c) if k == 3 else (lines[k, 0], lines[k, 1], lines[k, 2])
            size = clip(room.first, size, la, lb, lc, room.second)
            copy(room.second, size, room.first)
        if area_of(room.first, size) <= EMPTY or count + 4 > PIECES:
            piece += 1
            continue
        size = room.sizes[piece]
        meets = True
        copy(room.pieces[piece], size, room.first)
        count -= 1
        copy(room.pieces[count], room.sizes[count], room.pieces[piece])
        room.sizes[piece] = room.sizes[count]
        for k in range(4):
            la, lb, lc = (a, b, c) if k == 3 else (lines[k, 0], lines[k, 1], lines[k, 2])
            outside = clip(room.first, size, -la, -lb, -lc, room.pieces[count])
            if area_of(room.pieces[count], outside) > EMPTY:
                room.sizes[count] = outside
                count += 1
            size = clip(room.first, size, la, lb, lc, room.second)
            copy(room.second, size, room.first)
    return count, meets


@jit_inline
def _sum(room, count):
    """The area of pieces and its first moments."""
    area = x = y = 0.0
    for piece in range(count):
        polygon = room.pieces[piece]
        for k in range(1, room.sizes[piece] - 1):
            share = 0.5 * abs(double_area(polygon, k))
            area += share
            x += share * (polygon[0, 0] + polygon[k, 0] + polygon[k + 1, 0]) / 3.0
            y += share * (polygon[0, 1] + polygon[k, 1] + polygon[k + 1, 1]) / 3.0
    return area, x, y
