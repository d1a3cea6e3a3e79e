"""Compiled ends of an image: the list of pixels that show something, and pixels from values at
samples.

An image is a background, the values at the centres of the pixels that show a face, and for each
visible edge fragment its weight times (value outside - value inside): the sum of
`render/README.md`. `reference/images.py` is the reference.
"""

from habitus.kernels.jit import jit_noalloc


@jit_noalloc
def count_pixels(ids, begin, end, counts):
    """How many pixels of rows begin..end show a face, row by row."""
    for y in range(begin, end):
        total = 0
        for x in range(ids.shape[1]):
            total += ids[y, x] >= 0
        counts[y] = total


@jit_noalloc
def list_pixels(ids, offset, begin, end, pixels, faces, points):
    """The pixels of rows begin..end that show a face: their numbers, faces and centres."""
    for y in range(begin, end):
        n = offset[y]
        for x in range(ids.shape[1]):
            if ids[y, x] >= 0:
                pixels[n], faces[n] = y * ids.shape[1] + x, ids[y, x]
                points[n, 0], points[n, 1] = x + 0.5, y + 0.5
                n += 1


@jit_noalloc
def lay_background(background, begin, end, image):
    """The background's values into pixels begin..end."""
    for p in range(begin, end):
        behind = p if len(background) > 1 else 0
        for k in range(image.shape[1]):
            image[p, k] = background[behind, k]


@jit_noalloc
def fill_pixels(pixels, values, begin, end, image):
    """Values of samples begin..end into their pixels."""
    for n in range(begin, end):
        for k in range(values.shape[1]):
            image[pixels[n], k] = values[n, k]


@jit_noalloc
def add_jumps(pixel, weight, inner, outer, values, background, image):
    """Add each fragment's jump times its weight; `inner` and `outer` are rows of values, -1 for the
    background's.

    A jump that is not finite is left out: nothing is mixed with an infinitely distant background.
    """
    for s in range(len(pixel)):
        p = pixel[s]
        behind = p if len(background) > 1 else 0
        for k in range(values.shape[1]):
            inside = values[inner[s], k] if inner[s] >= 0 else background[behind, k]
            outside = values[outer[s], k] if outer[s] >= 0 else background[behind, k]
            jump = outside - inside
            if abs(jump) < HUGE:
                image[p, k] += weight[s] * jump


@jit_noalloc
def fill_pixels_vjp(pixels, cotangent, begin, end, to_values):
    """Cotangents of samples begin..end, which fill pixels."""
    for n in range(begin, end):
        for k in range(cotangent.shape[1]):
            to_values[n, k] = cotangent[pixels[n], k]


@jit_noalloc
def add_jumps_vjp(
    pixel, weight, inner, outer, values, background, cotangent, to_values, to_background, to_weight
):
    """VJP of `add_jumps`: added to the cotangents of values and background, written to that of
    weights.
    """
    for s in range(len(pixel)):
        p = pixel[s]
        behind = p if len(background) > 1 else 0
        total = 0.0
        for k in range(values.shape[1]):
            inside = values[inner[s], k] if inner[s] >= 0 else background[behind, k]
            outside = values[outer[s], k] if outer[s] >= 0 else background[behind, k]
            jump = outside - inside
            if abs(jump) < HUGE:
                change = cotangent[p, k]
                total += change * jump
                if inner[s] >= 0:
                    to_values[inner[s], k] -= weight[s] * change
                else:
                    to_background[behind, k] -= weight[s] * change
                if outer[s] >= 0:
                    to_values[outer[s], k] += weight[s] * change
                else:
                    to_background[behind, k] += weight[s] * change
        to_weight[s] = total


HUGE = 1e30
"""No finite jump is as large."""


@jit_noalloc
def fragment_weights_vjp(screen, fragments, cotangent, out):
    """Add to `out` (V, 3) the cotangent of the screen, given that of fragments' weights.

    fragments: tail, head, start, end and outward of each.
    """
    tail, head, start, end, outward = fragments
    for s in range(len(cotangent)):
        p = tail[s]
        q = head[s]
        middle = 0.5 * (start[s] + end[s])
        scale = cotangent[s] * outward[s] * (end[s] - start[s])
        x = scale * (screen[q, 1] - screen[p, 1])
        y = scale * (screen[q, 0] - screen[p, 0])
        out[p, 0] -= (1.0 - middle) * x
        out[p, 1] += (1.0 - middle) * y
        out[q, 0] -= middle * x
        out[q, 1] += middle * y
