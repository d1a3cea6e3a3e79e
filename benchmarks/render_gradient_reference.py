"""Pictures by brute force, to hold the renderer's derivatives against: many rays through every
pixel, nothing else.

It shares no code and no idea with the renderer: no depth image, no edges, no coverage. A ray
through each of `samples`² places of a pixel meets the triangles in camera space (3 x 3 inverses, so
that attributes are right in perspective by themselves), the nearest one gives its colour, and a
pixel is the mean. The places form the lattice of the golden ratio: few edges have a row of them
along their side, so that the mean grows evenly as an edge moves. (With a sheared square grid,
derivatives of the body's outlines were off by a tenth of their norm.)
"""

import numpy as np
from numba import njit, prange


def ray_cast(
    size: tuple[int, int],
    focal_length: float,
    points: np.ndarray,
    faces: np.ndarray,
    values: np.ndarray,
    background: float,
    texture: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    samples: int = 32,
    only: np.ndarray | None = None,
) -> np.ndarray:
    """The picture (H, W, C), box-filtered.

    `size` is (width, height) in pixels, the principal point is its middle. `points` (V, 3) are in
    camera space, in front of the camera. `values` (V, C) are linear on triangles; a `texture` (h,
    w, C), met at `uv` (V, 2) with bilinear weights and repeated beyond [0, 1], multiplies them. One
    sample a pixel is its centre. Pixels that are not `only` (H, W) stay background.
    """
    width, height = size
    if only is None:
        only = np.ones((height, width), bool)
    if texture is None:
        texture = np.ones((0, 0, 0))
        uv = np.zeros((len(points), 2))
    corners = points[faces]
    inverse = np.zeros((len(faces), 3, 3))
    solid = np.abs(np.linalg.det(corners)) > 1e-18
    inverse[solid] = np.linalg.inv(corners[solid].transpose(0, 2, 1))
    screen = corners[..., :2] / corners[..., 2:] * focal_length + np.array([width, height]) / 2
    low = np.floor(screen.min(1)).astype(np.int64)
    high = np.floor(screen.max(1)).astype(np.int64)
    bins = _bins(
        width, height, solid, np.maximum(low, 0), np.minimum(high, np.array([width, height]) - 1)
    )
    picture = np.full((height, width, values.shape[1]), float(background))
    colours = faces, values, texture, uv
    _cast(
        picture, only, focal_length, *bins, inverse, *colours, float(background), *_places(samples)
    )
    return picture


def _places(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Where in a pixel the rays go, across and down, each (samples, samples): the lattice of the
    golden ratio.
    """
    number = np.arange(samples**2)
    across = (number + 0.5) / samples**2
    down = (0.5 + number * (5**0.5 - 1) / 2) % 1
    return across.reshape(samples, samples), down.reshape(samples, samples)


@njit(cache=True)
def _bins(width, height, solid, low, high):
    """The triangles whose boxes touch each pixel: offsets (W H + 1,) and members."""
    start = np.zeros(width * height + 1, np.int64)
    for fill in range(2):
        if fill:
            start = np.concatenate((np.zeros(1, np.int64), np.cumsum(start[:-1])))
            member = np.empty(start[-1], np.int64)
            place = start.copy()
        for face in np.flatnonzero(solid):
            for row in range(low[face, 1], high[face, 1] + 1):
                for column in range(low[face, 0], high[face, 0] + 1):
                    if fill:
                        member[place[row * width + column]] = face
                        place[row * width + column] += 1
                    else:
                        start[row * width + column] += 1
    return start, member


@njit(cache=True, parallel=True, error_model="numpy")
def _cast(
    picture,
    only,
    focal,
    start,
    member,
    inverse,
    faces,
    values,
    texture,
    uv,
    background,
    across,
    down,
):
    height, width, channels = picture.shape
    for pixel in prange(height * width):
        row = pixel // width
        column = pixel % width
        if start[pixel] == start[pixel + 1] or not only[row, column]:
            continue
        members = member[start[pixel] : start[pixel + 1]]
        kept, at = _touching(members, inverse, focal, column - width / 2, row - height / 2)
        total = np.zeros(channels)
        misses = 0
        length = across.shape[1]
        nearest = np.empty(length, np.int64)
        best = np.empty(length)
        weights = np.empty((3, length))
        for line in range(len(across)):
            _find_nearest(at, across[line], down[line], nearest, best, weights)
            for n in range(length):
                if nearest[n] < 0:
                    misses += 1
                else:
                    share = (
                        weights[0, n] / best[n],
                        weights[1, n] / best[n],
                        weights[2, n] / best[n],
                    )
                    _shade(total, faces[kept[nearest[n]]], share, values, texture, uv)
        picture[row, column] = (total + misses * background) / across.size


@njit(cache=True)
def _touching(members, inverse, focal, x, y):
    """The triangles that rays of a pixel may meet, x and y its corner.

    For each corner of those: w, which is linear over the pixel (at its corner, its growth to the
    right, and downwards). Rays (x, y, 1) have w >= 0 at all three where they meet a triangle, at 1
    / depth = their sum.
    """
    at = np.empty((len(members), 3, 3))
    kept = np.empty(len(members), np.int64)
    count = 0
    for face in members:
        touches = True
        for k in range(3):
            right = inverse[face, k, 0] / focal
            below = inverse[face, k, 1] / focal
            here = right * x + below * y + inverse[face, k, 2]
            at[count, k, 0], at[count, k, 1], at[count, k, 2] = here, right, below
            touches = touches and here + max(right, 0.0) + max(below, 0.0) >= 0
        if touches:
            kept[count] = face
            count += 1
    return kept[:count], at[:count]


@njit(cache=True)
def _find_nearest(at, across, down, nearest, best, weights):
    """For places (N,) of a pixel the nearest triangle (-1: none), its 1 / depth and its corners' w
    (3, N).
    """
    nearest[:], best[:] = -1, 0.0
    for k in range(len(at)):
        a, au, av = at[k, 0]
        b, bu, bv = at[k, 1]
        c, cu, cv = at[k, 2]
        for n in range(len(across)):
            p = a + across[n] * au + down[n] * av
            q = b + across[n] * bu + down[n] * bv
            r = c + across[n] * cu + down[n] * cv
            if min(p, q, r) >= 0 and p + q + r > best[n]:
                nearest[n], best[n] = k, p + q + r
                weights[0, n], weights[1, n], weights[2, n] = p, q, r


@njit(cache=True)
def _shade(total, corners, weight, values, texture, uv):
    """Add the colour of a point on a triangle."""
    one = corners[0]
    two = corners[1]
    three = corners[2]
    a, b, c = weight
    if texture.shape[0] == 0:
        for channel in range(len(total)):
            total[channel] += (
                a * values[one, channel] + b * values[two, channel] + c * values[three, channel]
            )
        return
    height, width, _ = texture.shape
    x = (a * uv[one, 0] + b * uv[two, 0] + c * uv[three, 0]) * width - 0.5
    y = (1 - (a * uv[one, 1] + b * uv[two, 1] + c * uv[three, 1])) * height - 0.5
    left = int(np.floor(x))
    top = int(np.floor(y))
    x = x - left
    y = y - top
    left, right, top, bottom = left % width, (left + 1) % width, top % height, (top + 1) % height
    for channel in range(len(total)):
        value = a * values[one, channel] + b * values[two, channel] + c * values[three, channel]
        upper = (1 - x) * texture[top, left, channel] + x * texture[top, right, channel]
        lower = (1 - x) * texture[bottom, left, channel] + x * texture[bottom, right, channel]
        total[channel] += value * ((1 - y) * upper + y * lower)
