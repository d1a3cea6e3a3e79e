"""Mipmapped textures, compiled: samples, and their derivatives with respect to texels and uv.

The levels of a texture lie behind one another in `texels` (T, C), row by row; `table` (L, 3) says
of each level where it begins, how many rows it has, and how many columns. A sample at level k + s,
s in [0, 1), is

    (1 - s) B_k + s B_(k+1),   B = (1 - y) ((1 - x) a + x b) + y ((1 - x) c + x d),

with the four texels a, b (above), c, d (below) around the point, and how far it lies, x and y, from
the centre of the first towards that of the last. Texture coordinates are computed in float64
whatever the texels are. `habitus.render.reference.textures` is the reference.
"""

import numpy as np

from habitus.kernels.jit import jit

BAND = 4
"""Rows of texels that one thread after the other takes when derivatives are added up."""


@jit
def sample_texels(texels, table, wraps, uv, level, begin, end, out):
    """Fill samples `begin` to `end` of `out` (N, C) at `uv` (N, 2) and `level` (N,), within 0 and L
    - 1.
    """
    real = texels.dtype.type
    channels = np.uint64(texels.shape[1])
    for n in range(np.uint64(begin), np.uint64(end)):
        u = float(uv[n, 0])
        v = 1.0 - uv[n, 1]
        finest = int(level[n])
        share = float(level[n]) - finest
        for step in range(2 if share > 0.0 else 1):
            start, height, width = table[finest + step]
            left, right, x = neighbours(u, width, wraps[0])
            top, bottom, y = neighbours(v, height, wraps[1])
            above = start + top * width
            below = start + bottom * width
            a = above + left
            b = above + right
            c = below + left
            d = below + right
            weight = share if step else 1.0 - share
            at_a = real(weight * (1.0 - y) * (1.0 - x))
            at_b = real(weight * (1.0 - y) * x)
            at_c = real(weight * y * (1.0 - x))
            at_d = real(weight * y * x)
            for k in range(channels):
                value = (at_a * texels[a, k] + at_b * texels[b, k]) + (
                    at_c * texels[c, k] + at_d * texels[d, k]
                )
                out[n, k] = out[n, k] + value if step else value


@jit
def sample_uv_vjp(texels, table, wraps, uv, level, cotangent, begin, end, out):
    """Fill `begin` to `end` of `out` (N, 2): the derivative to `uv` of the sum of samples times
    `cotangent` (N, C).
    """
    real = texels.dtype.type
    channels = np.uint64(texels.shape[1])
    for n in range(np.uint64(begin), np.uint64(end)):
        u = float(uv[n, 0])
        v = 1.0 - uv[n, 1]
        finest = int(level[n])
        share = float(level[n]) - finest
        along_u = 0.0
        along_v = 0.0
        for step in range(2 if share > 0.0 else 1):
            start, height, width = table[finest + step]
            left, right, x = neighbours(u, width, wraps[0])
            top, bottom, y = neighbours(v, height, wraps[1])
            above = start + top * width
            below = start + bottom * width
            a = above + left
            b = above + right
            c = below + left
            d = below + right
            upper = real(0.0)
            lower = real(0.0)
            across = (real(0.0), real(0.0))
            for k in range(channels):
                p = texels[a, k]
                q = texels[b, k]
                r = texels[c, k]
                s = texels[d, k]
                upper += cotangent[n, k] * (q - p)
                lower += cotangent[n, k] * (s - r)
                across = (
                    across[0] + cotangent[n, k] * (r - p),
                    across[1] + cotangent[n, k] * (s - q),
                )
            weight = share if step else 1.0 - share
            along_u += weight * float(width) * ((1.0 - y) * upper + y * lower)
            along_v -= weight * float(height) * ((1.0 - x) * across[0] + x * across[1])
        out[n, 0], out[n, 1] = along_u, along_v


@jit
def sample_texels_vjp(table, wraps, uv, level, cotangent, stripes, begin, end, out):
    """Add the derivative to the texels of the sum of samples times `cotangent` (N, C) to `out` (T,
    C).

    Bands of rows are numbered in turn 0 to `stripes` - 1 (a power of two); only numbers from
    `begin` up to `end` are added to: threads share the bands, each goes through all samples, and
    the sums are the same for any number of them.
    """
    real = out.dtype.type
    channels = np.uint64(out.shape[1])
    mask = np.uint64(stripes - 1)
    for n in range(np.uint64(len(uv))):
        u = float(uv[n, 0])
        v = 1.0 - uv[n, 1]
        finest = int(level[n])
        share = float(level[n]) - finest
        for step in range(2 if share > 0.0 else 1):
            start, height, width = table[finest + step]
            top, bottom, y = neighbours(v, height, wraps[1])
            left, right, x = neighbours(u, width, wraps[0])
            weight = share if step else 1.0 - share
            for row, along_row in ((top, weight * (1.0 - y)), (bottom, weight * y)):
                if begin <= int(row // BAND & mask) < end:
                    a = start + row * width + left
                    b = start + row * width + right
                    at_a = real(along_row * (1.0 - x))
                    at_b = real(along_row * x)
                    for k in range(channels):
                        out[a, k] += at_a * cotangent[n, k]
                        out[b, k] += at_b * cotangent[n, k]


@jit
def neighbours(coordinate, size, repeat):
    """The two texels beside a coordinate (1 is the whole length), and how far it lies from the
    first's centre to the next's.

    A coordinate that is not finite gives texels that exist and a fraction that is NaN.
    """
    count = np.int64(size)
    if repeat:
        coordinate -= np.floor(coordinate)
    x = coordinate * count - 0.5
    lower = np.floor(x)
    first = int(lower) if -1.0 <= lower < count else (-1 if lower < 0.0 else count)
    second = first + 1
    if repeat:
        first = count - 1 if first < 0 else first
        second = 0 if second >= count else second
    else:
        first = max(first, 0)
        second = min(second, count - 1)
    return np.uint64(min(first, count - 1)), np.uint64(second), x - lower
