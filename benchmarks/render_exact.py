"""Pictures by exact areas, to hold the renderer against: what of each triangle shows in a pixel, as
polygons.

It shares no code and no idea with the renderer: no centres, no edges, no fragments. In each pixel
every triangle is clipped to the pixel, and from what is left is cut away where another triangle
covers it and is nearer: 1 / depth is linear on the screen, so that is a convex region, also where
surfaces pass through each other. What remains are convex polygons, over which colours, linear in
space, are integrated by the midpoints of sides (exact up to squares). A picture is a smooth
function of the vertices to rounding, so its central differences over 1e-4 pixels are derivatives,
and whole pictures take seconds.
"""

import numpy as np
from numba import njit, prange

CORNERS, PIECES = 16, 96
"""Room for the corners of a polygon (a pixel's square and at most four cuts more each) and for
pieces of a triangle.
"""
EMPTY = 1e-13
"""Square pixels below which nothing is left."""


def exact_picture(
    screen: np.ndarray, faces: np.ndarray, values: np.ndarray, background: float, only: np.ndarray
) -> np.ndarray:
    """The picture (H, W, C), box-filtered. Pixels that are not `only` (H, W) stay background.

    screen (V, 3): u, v in pixels and depth, all in front of the camera; values (V, C), linear on
    triangles in space.
    """
    height, width = only.shape
    corners = screen[faces]
    low = np.floor(corners[..., :2].min(1)).astype(np.int64)
    high = np.floor(corners[..., :2].max(1)).astype(np.int64)
    sides = np.cross(corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2])
    start, member = _bins(width, height, only, np.abs(sides) > EMPTY, low, high)
    picture = np.full((height, width, values.shape[1]), float(background))
    full = _fill(picture, only, start, member, corners, values[faces], float(background))
    if full:
        raise RuntimeError(f"{full} triangles fell into more than {PIECES} pieces in a pixel")
    return picture


@njit(cache=True)
def _bins(width, height, only, solid, low, high):
    """The triangles whose boxes touch each pixel: offsets (W H + 1,) and members."""
    start = np.zeros(width * height + 1, np.int64)
    for fill in range(2):
        if fill:
            start = np.concatenate((np.zeros(1, np.int64), np.cumsum(start[:-1])))
            member = np.empty(start[-1], np.int64)
            place = start.copy()
        for face in np.flatnonzero(solid):
            for row in range(max(low[face, 1], 0), min(high[face, 1], height - 1) + 1):
                for column in range(max(low[face, 0], 0), min(high[face, 0], width - 1) + 1):
                    if not only[row, column]:
                        continue
                    if fill:
                        member[place[row * width + column]] = face
                        place[row * width + column] += 1
                    else:
                        start[row * width + column] += 1
    return start, member


@njit(cache=True, parallel=True, error_model="numpy")
def _fill(picture, only, start, member, corners, values, background):
    """Fill pixels; how many triangles had no room for their pieces."""
    height, width, channels = picture.shape
    full = 0
    for row in prange(height):
        pieces = np.empty((PIECES, CORNERS, 2))
        sizes = np.empty(PIECES, np.int64)
        rest = np.empty((CORNERS, 2))
        cut = np.empty((CORNERS, 2))
        part = np.empty((CORNERS, 2))
        for column in range(width):
            pixel = row * width + column
            first = start[pixel]
            last = start[pixel + 1]
            if first == last or not only[row, column]:
                continue
            planes = np.empty((last - first, 4, 3))
            for n in range(last - first):
                _lines(corners[member[first + n]], column, row, planes[n])
            total = np.zeros(channels)
            area = 0.0
            for n in range(last - first):
                count = _visible(planes, n, pieces, sizes, rest, cut, part)
                full += count < 0
                for piece in range(max(count, 0)):
                    area += _add(
                        total,
                        pieces[piece, : sizes[piece]],
                        corners[member[first + n]],
                        values[member[first + n]],
                        column,
                        row,
                    )
            picture[row, column] = total + (1.0 - area) * background
    return full


@njit(cache=True, error_model="numpy")
def _lines(corner, column, row, out):
    """Of a triangle: the three lines of its sides, positive inside, and its 1 / depth; each as a x
    + b y + c.
    """
    x = corner[:, 0] - column
    y = corner[:, 1] - row
    area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0])
    out[3] = 0.0
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        out[k, 0], out[k, 1] = (y[i] - y[j]) / area, (x[j] - x[i]) / area
        out[k, 2] = (x[i] * y[j] - x[j] * y[i]) / area
        out[3] += out[k] / corner[k, 2]


@njit(cache=True, error_model="numpy")
def _visible(planes, n, pieces, sizes, rest, cut, part):
    """What shows of triangle n in its pixel: convex polygons, their number; -1 if there is no room
    for them.
    """
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rest[:4] = square
    size = 4
    for k in range(3):
        size = _clip(rest, size, planes[n, k], 1.0, cut)
        rest[:size] = cut[:size]
    if _area(rest, size) < EMPTY:
        return 0
    pieces[0, :size], sizes[0] = rest[:size], size
    count = 1
    nearer = np.empty((4, 3))
    for other in range(len(planes)):
        if other == n:
            continue
        nearer[:3] = planes[other, :3]
        nearer[3] = planes[other, 3] - planes[n, 3]
        piece = 0
        while piece < count:
            size = sizes[piece]
            rest[:size] = pieces[piece, :size]
            for k in range(4):
                size = _clip(rest, size, nearer[k], 1.0, cut)
                rest[:size] = cut[:size]
                if size == 0:
                    break
            if _area(rest, size) < EMPTY:
                piece += 1
                continue
            size = sizes[piece]
            rest[:size] = pieces[piece, :size]
            count -= 1
            if (
                piece < count
            ):  # the last takes the place of the one that is cut up; new ones go behind
                pieces[piece], sizes[piece] = pieces[count], sizes[count]
            fresh = count
            for k in range(4):
                outside = _clip(rest, size, nearer[k], -1.0, part)
                if _area(part, outside) > EMPTY:
                    if fresh == len(pieces):
                        return -1
                    pieces[fresh, :outside], sizes[fresh] = part[:outside], outside
                    fresh += 1
                size = _clip(rest, size, nearer[k], 1.0, cut)
                rest[:size] = cut[:size]
            count = fresh
    return count


@njit(cache=True, error_model="numpy")
def _clip(polygon, size, line, sign, out):
    """The part of a convex polygon where sign * line >= 0 (Sutherland and Hodgman 1974); its number
    of corners.
    """
    count = 0
    for k in range(size):
        following = (k + 1) % size
        here = sign * (line[0] * polygon[k, 0] + line[1] * polygon[k, 1] + line[2])
        there = sign * (line[0] * polygon[following, 0] + line[1] * polygon[following, 1] + line[2])
        if here >= 0.0:
            out[count] = polygon[k]
            count += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            t = here / (here - there)
            out[count] = polygon[k] + t * (polygon[following] - polygon[k])
            count += 1
    return count


@njit(cache=True)
def _area(polygon, size):
    double = 0.0
    for k in range(1, size - 1):
        ax = polygon[k, 0] - polygon[0, 0]
        ay = polygon[k, 1] - polygon[0, 1]
        bx = polygon[k + 1, 0] - polygon[0, 0]
        by = polygon[k + 1, 1] - polygon[0, 1]
        double += ax * by - ay * bx
    return abs(double) / 2.0


@njit(cache=True, error_model="numpy")
def _add(total, polygon, corner, value, column, row):
    """Add a triangle's colour, integrated over a polygon of it; the polygon's area."""
    area = 0.0
    x = corner[:, 0] - column
    y = corner[:, 1] - row
    for k in range(1, len(polygon) - 1):
        a = polygon[0]
        b = polygon[k]
        c = polygon[k + 1]
        piece = abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) / 2.0
        area += piece
        for i in range(3):
            p, q = (a, b) if i == 0 else ((b, c) if i == 1 else (c, a))
            u = (p[0] + q[0]) / 2.0
            v = (p[1] + q[1]) / 2.0
            f = ((x[2] - x[1]) * (v - y[1]) - (y[2] - y[1]) * (u - x[1])) / corner[0, 2]
            g = ((x[0] - x[2]) * (v - y[2]) - (y[0] - y[2]) * (u - x[2])) / corner[1, 2]
            h = ((x[1] - x[0]) * (v - y[0]) - (y[1] - y[0]) * (u - x[0])) / corner[2, 2]
            share = piece / 3.0 / (f + g + h)
            for channel in range(len(total)):
                total[channel] += share * (
                    f * value[0, channel] + g * value[1, channel] + h * value[2, channel]
                )
    return area
