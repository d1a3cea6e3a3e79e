"""Compiled rasteriser: triangles into tiles, tiles into the nearest triangle at each pixel's centre.

All works on the screen: u to the right, v down, in pixels; w = 1 / depth is linear there. An edge's value at a point is
computed from its two ends in one fixed order, so that the triangles on its two sides get exactly opposite numbers: no
holes, no double hits. `reference.py` says the same slowly.
"""

import numpy as np

from habitus.compiled import compiled

TILE = 16
"""Pixels along a tile's side."""


@compiled
def ordered_line(px, py, qx, qy):
    """The line through p and q: its first end (the upper, else the left), its step, and whether p -> q runs along."""
    if py < qy or (py == qy and px <= qx):
        return px, py, qx - px, qy - py, 1.0
    return qx, qy, px - qx, py - qy, -1.0


@compiled
def side(x0, y0, dx, dy, x, y):
    """Twice the area between a line and a point: positive to the right of its direction as seen on the screen."""
    return dx * (y - y0) - dy * (x - x0)


@compiled
def double_area(screen, a, b, c):
    """Twice a triangle's area on the screen; negative where it shows its front (counter-clockwise, v pointing down)."""
    x0, y0, dx, dy, along = ordered_line(screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1])
    return along * side(x0, y0, dx, dy, screen[c, 0], screen[c, 1])


@compiled
def place_faces(screen, faces, usable, cull, width, height, begin, end, facing, boxes, counts):
    """How each face lies (+1, -1; 0: not drawn), the tiles that its box meets, and how many faces meet each tile."""
    tiles = (width + TILE - 1) // TILE
    for f in range(begin, end):
        facing[f] = 0
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if not (usable[a] and usable[b] and usable[c]):
            continue
        area = double_area(screen, a, b, c)
        if area == 0.0 or (cull and area > 0.0):
            continue
        low_x = min(screen[a, 0], screen[b, 0], screen[c, 0])
        high_x = max(screen[a, 0], screen[b, 0], screen[c, 0])
        low_y = min(screen[a, 1], screen[b, 1], screen[c, 1])
        high_y = max(screen[a, 1], screen[b, 1], screen[c, 1])
        if high_x < 0.0 or low_x > width or high_y < 0.0 or low_y > height:
            facing[f] = 2 if area > 0.0 else -2
            continue
        facing[f] = 1 if area > 0.0 else -1
        boxes[f, 0] = int(max(low_x, 0.0)) // TILE
        boxes[f, 1] = min(int(min(high_x, float(width))) // TILE, tiles - 1)
        boxes[f, 2] = int(max(low_y, 0.0)) // TILE
        boxes[f, 3] = min(int(min(high_y, float(height))), height - 1) // TILE
        boxes[f, 0] = min(boxes[f, 0], boxes[f, 1])
        boxes[f, 2] = min(boxes[f, 2], boxes[f, 3])
        for row in range(boxes[f, 2], boxes[f, 3] + 1):
            for column in range(boxes[f, 0], boxes[f, 1] + 1):
                counts[row * tiles + column] += 1


@compiled
def list_faces(facing, boxes, tiles, begin, end, cursor, listed):
    """Write each face into the lists of its tiles, in order of faces; `cursor` says where each list goes on."""
    for f in range(begin, end):
        if facing[f] != 1 and facing[f] != -1:
            continue
        for row in range(boxes[f, 2], boxes[f, 3] + 1):
            for column in range(boxes[f, 0], boxes[f, 1] + 1):
                tile = row * tiles + column
                listed[cursor[tile]] = f
                cursor[tile] += 1


@compiled
def draw_tiles(screen, inverse, faces, starts, listed, width, height, begin, end, ids):
    """The nearest face at each pixel centre of tiles begin..end; of equally near ones the first."""
    tiles = (width + TILE - 1) // TILE
    nearest = np.empty((TILE, TILE))
    for tile in range(begin, end):
        top, left = tile // tiles * TILE, tile % tiles * TILE
        bottom, right = min(top + TILE, height), min(left + TILE, width)
        nearest[:] = 0.0
        for k in range(starts[tile], starts[tile + 1]):
            _draw_face(screen, inverse, faces, listed[k], top, left, bottom, right, nearest, ids)


@compiled
def _draw_face(screen, inverse, faces, f, top, left, bottom, right, nearest, ids):
    """One face into one tile, by pixels of its box; a row is left as soon as the face ends in it."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ax, ay, bx, by, cx, cy = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
    x_first = max(left, int(np.ceil(max(min(ax, bx, cx), float(left)) - 0.5)))
    x_last = min(right - 1, int(np.floor(min(max(ax, bx, cx), float(right)) - 0.5)))
    y_first = max(top, int(np.ceil(max(min(ay, by, cy), float(top)) - 0.5)))
    y_last = min(bottom - 1, int(np.floor(min(max(ay, by, cy), float(bottom)) - 0.5)))
    if x_first > x_last or y_first > y_last:
        return
    ax0, ay0, adx, ady, a_along = ordered_line(bx, by, cx, cy)
    bx0, by0, bdx, bdy, b_along = ordered_line(cx, cy, ax, ay)
    cx0, cy0, cdx, cdy, c_along = ordered_line(ax, ay, bx, by)
    area = c_along * side(cx0, cy0, cdx, cdy, cx, cy)
    turn = 1.0 if area > 0.0 else -1.0
    a_sign, b_sign, c_sign = turn * a_along, turn * b_along, turn * c_along
    a_own, b_own, c_own = _owns(ady, a_sign), _owns(bdy, b_sign), _owns(cdy, c_sign)
    aw, bw, cw = inverse[a] / abs(area), inverse[b] / abs(area), inverse[c] / abs(area)
    for y in range(y_first, y_last + 1):
        v = y + 0.5
        a_row, b_row, c_row = adx * (v - ay0), bdx * (v - by0), cdx * (v - cy0)
        entered = False
        for x in range(x_first, x_last + 1):
            u = x + 0.5
            ea = a_sign * (a_row - ady * (u - ax0))
            eb = b_sign * (b_row - bdy * (u - bx0))
            ec = c_sign * (c_row - cdy * (u - cx0))
            inside = (ea > 0.0) & (eb > 0.0) & (ec > 0.0)
            if not inside and min(ea, eb, ec) == 0.0:
                inside = (ea > 0.0 or (ea == 0.0 and a_own)) and (eb > 0.0 or (eb == 0.0 and b_own))
                inside = inside and (ec > 0.0 or (ec == 0.0 and c_own))
            if inside:
                entered = True
                w = ea * aw + eb * bw + ec * cw
                if w > nearest[y - top, x - left]:
                    nearest[y - top, x - left] = w
                    ids[y, x] = f
            elif entered:
                break


@compiled
def _owns(dy, sign):
    """The top-left rule: whether a centre exactly on an edge is its face's, the inside having values of `sign`."""
    return sign < 0.0 if dy > 0.0 else sign > 0.0


@compiled
def nearest_face(screen, inverse, faces, starts, listed, width, height, x, y):
    """The nearest face over any point of the image and its w; -1 and 0 where there is none."""
    tiles, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    column = min(max(int(x) // TILE, 0), tiles - 1)
    row = min(max(int(y) // TILE, 0), rows - 1)
    tile = row * tiles + column
    found, best = -1, 0.0
    for k in range(starts[tile], starts[tile + 1]):
        f = listed[k]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, bx, cx = screen[a, 0], screen[b, 0], screen[c, 0]
        if (ax < x and bx < x and cx < x) or (ax > x and bx > x and cx > x):
            continue
        ay, by, cy = screen[a, 1], screen[b, 1], screen[c, 1]
        if (ay < y and by < y and cy < y) or (ay > y and by > y and cy > y):
            continue
        ea = (cx - bx) * (y - by) - (cy - by) * (x - bx)
        eb = (ax - cx) * (y - cy) - (ay - cy) * (x - cx)
        ec = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        if (ea >= 0.0 and eb >= 0.0 and ec >= 0.0) or (ea <= 0.0 and eb <= 0.0 and ec <= 0.0):
            w = (ea * inverse[a] + eb * inverse[b] + ec * inverse[c]) / (ea + eb + ec)
            if w > best:
                found, best = f, w
    return found, best
