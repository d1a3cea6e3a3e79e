"""Compiled search for the edges at which an image jumps, cut into fragments of one pixel each.

An image jumps where a surface ends in front of another: at borders, at silhouettes (all faces of an
edge lie on one side of it) and at seams, whose two sides may differ in value. Each visible fragment
gets the area that it cuts off in its pixel: box filtering is then the value at the centre plus jump
times area, summed over fragments, however many edges meet in the pixel. `reference/segments.py` is
the reference.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc
from habitus.render.kernels.raster import is_inside
from habitus.render.kernels.shadows import shadow
from habitus.render.kernels.tiles import covered, nearest_face
from habitus.render.kernels.vectors import greater, lesser

BESIDE = 1e-5
"""How far outside an edge the surface behind it is looked up, in pixels."""
HIDDEN = 1e-6
"""A surface hides an edge from this difference of w on, relative to the edge's."""
SHORTEST = 1e-9
"""Fragments shorter than this many pixels are left out."""
ENDS = 1e-3
"""How far from a fragment's ends it is tested whether they show, in lengths of the fragment."""
TOUCHING = 1e-9
"""What crosses a ray at its beginning, in lengths of the ray."""
TURN_STEPS = 14
"""Bisections of half a fragment on the way to the place where it disappears."""


@jit_noalloc
def choose_edges(on_screen, edges, width, height, begin, end, chosen):
    """Write those of edges begin..end at which an image may jump: how many."""
    screen, _, _, facing = on_screen
    count = 0
    for e in range(begin, end):
        one = edges.pair[e, 0]
        other = edges.pair[e, 1]
        if one >= 0 and (facing[one] * facing[other] > 0 or facing[one] == facing[other]):
            continue  # the surface goes on, or is not drawn: so it is at most edges
        entry, two_sided = _border(
            on_screen, edges, edges.start[e], edges.start[e + 1], edges.seam[e]
        )
        if entry < 0:
            continue
        p = edges.corners[entry, 0]
        q = edges.corners[entry, 1]
        start, stop = _clip(
            screen[p, 0], screen[p, 1], screen[q, 0], screen[q, 1], float(width), float(height)
        )
        if start < stop:
            chosen.face[count], chosen.two_sided[count] = edges.face[entry], two_sided
            chosen.tail[count], chosen.head[count] = p, q
            dx = screen[q, 0] - screen[p, 0]
            dy = screen[q, 1] - screen[p, 1]
            chosen.start[count], chosen.stop[count] = start, stop
            chosen.most[count] = 3 + int(abs(dx) * (stop - start)) + int(abs(dy) * (stop - start))
            count += 1
    return count


@jit_inline
def _border(on_screen, edges, begin, end, seam):
    """Of the faces around an edge (entries begin..end of the lists) the one whose border may show,
    or -1; and whether faces lie on both sides. Of faces on one side that is the nearest, the first
    in the lists if they are alone.
    """
    sides = 0
    for k in range(begin, end):
        sides |= _side_of_edge(on_screen, edges, k)
    if sides == 0 or (sides == 3 and not seam):
        return np.int64(-1), False
    chosen = np.int64(-1)
    steepest = 0.0
    for k in range(begin, end):
        if _side_of_edge(on_screen, edges, k) == sides & -sides:
            slope = _slope_inward(on_screen, edges.corners[k])
            if chosen < 0 or slope > steepest:
                chosen = np.int64(k)
                steepest = slope
    return chosen, sides == 3


@jit_inline
def _side_of_edge(on_screen, edges, k):
    """On which side of an edge a face of it lies: 1 or 2, 0 where the face is not drawn."""
    screen, _, _, facing = on_screen
    f = edges.face[k]
    if facing[f] == 0:
        return 0
    p = edges.corners[k, 0]
    q = edges.corners[k, 1]
    px = screen[p, 0]
    py = screen[p, 1]
    qx = screen[q, 0]
    qy = screen[q, 1]
    runs_along = py < qy or (py == qy and px <= qx)  # as `ordered_line` has it
    return 1 if runs_along == (facing[f] > 0) else 2


@jit_inline
def _slope_inward(on_screen, corners):
    """How fast the w of a face of these corners grows inward from the edge between the first
    two.
    """
    screen, inverse, _, _ = on_screen
    p = np.uintp(corners[0])
    q = np.uintp(corners[1])
    third = np.uintp(corners[2])
    dx = screen[q, 0] - screen[p, 0]
    dy = screen[q, 1] - screen[p, 1]
    length = dx * dx + dy * dy
    if length == 0.0:
        return 0.0
    x = screen[third, 0] - screen[p, 0]
    y = screen[third, 1] - screen[p, 1]
    foot = (x * dx + y * dy) / length
    height = abs(dx * y - dy * x) / np.sqrt(length)
    return (
        (inverse[third] - inverse[p] - foot * (inverse[q] - inverse[p])) / height
        if height > 0.0
        else 0.0
    )


@jit_inline
def _clip(x0, y0, x1, y1, width, height):
    """The parameters between which a line lies in the image (Liang and Barsky 1984)."""
    start = 0.0
    stop = 1.0
    for axis in range(2):
        at, step, size = (x0, x1 - x0, width) if axis == 0 else (y0, y1 - y0, height)
        if step == 0.0:
            if at < 0.0 or at > size:
                return 1.0, 0.0
            continue
        near = -at / step
        far = (size - at) / step
        start = greater(start, lesser(near, far))
        stop = lesser(stop, greater(near, far))
    return start, stop


@jit_noalloc
def cut_edges(on_screen, tiles, chosen, offset, begin, end, near, found):
    """Cut chosen edges begin..end at the pixels' borders; write the visible fragments of edge e
    from `offset[e]` on.

    Fragments that an edge does not need keep the pixels that stood there. near: workspace of
    `covered`.
    """
    screen, inverse, _, facing = on_screen
    width = tiles.width
    height = tiles.height
    for e in range(begin, end):
        f = chosen.face[e]
        p = chosen.tail[e]
        q = chosen.head[e]
        n = offset[e]
        x0 = screen[p, 0]
        y0 = screen[p, 1]
        dx = screen[q, 0] - x0
        dy = screen[q, 1] - y0
        length = np.sqrt(dx * dx + dy * dy)
        outward = 1.0 if facing[f] > 0 else -1.0
        line = x0, y0, dx, dy, outward * BESIDE / length, inverse[p], inverse[q]
        stack = on_screen, tiles, near, _line_beside(line)
        near.place[0] = -1
        start = chosen.start[e]
        stop = chosen.stop[e]
        border = lesser(lesser(_next_border(x0, dx, start), _next_border(y0, dy, start)), stop)
        first = _shows(line, stack, start + ENDS * (border - start))
        while start < stop and n < offset[e + 1]:
            border = lesser(lesser(_next_border(x0, dx, start), _next_border(y0, dy, start)), stop)
            if (border - start) * length > SHORTEST:
                last = _shows(line, stack, border - ENDS * (border - start))
                low, high = _visible_interval(line, stack, start, border, first, last)
                first = last
                if low < high:
                    middle = 0.5 * (low + high)
                    x = x0 + middle * dx
                    y = y0 + middle * dy
                    column = lesser(int(x), width - 1)
                    row = lesser(int(y), height - 1)
                    found.pixel[n], found.tail[n], found.head[n] = row * width + column, p, q
                    found.face[n], found.seam[n], found.outward[n] = f, chosen.two_sided[e], outward
                    found.span[n, 0], found.span[n, 1], found.middle[n, 0], found.middle[n, 1] = (
                        low,
                        high,
                        x,
                        y,
                    )
                    u = column + 0.5
                    v = row + 0.5
                    area = shadow(
                        x0 + low * dx - u, y0 + low * dy - v, x0 + high * dx - u, y0 + high * dy - v
                    )
                    within = is_inside(x0, y0, screen[q, 0], screen[q, 1], outward, u, v)
                    found.weight[n] = area if within else -area
                    n += 1
            start = border


@jit_inline
def _line_beside(line):
    """The line just outside an edge, along which visibility is tested, as `covered` wants it."""
    x0, y0, dx, dy, beside, w0, w1 = line
    low_x = lesser(x0, x0 + dx) - BESIDE
    high_x = greater(x0, x0 + dx) + BESIDE
    low_y = lesser(y0, y0 + dy) - BESIDE
    high_y = greater(y0, y0 + dy) + BESIDE
    box = (
        np.float32(low_x),
        np.float32(high_x),
        np.float32(low_y),
        np.float32(high_y),
        np.float32(lesser(w0, w1)),
    )
    return *box, x0, y0, dx, dy, -beside * (dx * dx + dy * dy)


@jit_inline
def _shows(line, stack, t):
    """Whether nothing is in front of an edge at its parameter t, looked up just outside it."""
    x0, y0, dx, dy, beside, w0, w1 = line
    limit = ((1.0 - t) * w0 + t * w1) * (1.0 + HIDDEN)
    return not covered(*stack, x0 + t * dx + beside * dy, y0 + t * dy - beside * dx, limit)


@jit_inline
def _visible_interval(line, stack, low, high, first, last):
    """What shows of an edge between two parameters; `first` and `last`: whether its ends do.

    A change from hidden to visible is looked for by bisection, one on each side of the middle.
    """
    middle = 0.5 * (low + high)
    end = high
    centre = _shows(line, stack, middle)
    if not (first or centre or last):
        return 1.0, 0.0
    for half in range(2):
        before, after = (first, centre) if half == 0 else (centre, last)
        if before == after or (half == 1 and first and not centre):
            continue
        near, far = (low, middle) if half == 0 else (middle, end)
        for _ in range(TURN_STEPS):
            turn = 0.5 * (near + far)
            shows = _shows(line, stack, turn)
            near, far = (turn, far) if shows == before else (near, turn)
        turn = 0.5 * (near + far)
        low, high = (low, turn) if before else (turn, high)
    return low, high


@jit_noalloc
def find_sample_points(on_screen, tiles, ids, group, found, begin, end, sides):
    """Where to look up an image's values on the two sides of fragments, and the faces visible there
    (-1: none).

    Seen from the centre, the near side is looked up at the centre, the far one halfway to the
    pixel's border; where the line through the fragment's middle crosses other fragments, halfway to
    those. At a silhouette the surface is so slanted that its value at the very border says little
    about the pixel. Both points keep clear of the edge, and lie right beside it where its line runs
    through the centre. group: for pixels begin..end, the range of its fragments, which are sorted
    by pixel.
    """
    screen, (inner_face, outer_face, inner, outer) = on_screen.screen, sides
    for g in range(begin, end):
        for n in range(group[g], group[g + 1]):
            column = found.pixel[n] % tiles.width
            row = found.pixel[n] // tiles.width
            u = column + 0.5
            v = row + 0.5
            middle_x = found.middle[n, 0]
            middle_y = found.middle[n, 1]
            x = middle_x - u
            y = middle_y - v
            before, after = _others_on_ray(screen, found, group[g], group[g + 1], n, u, v, x, y)
            away = found.outward[n] if found.weight[n] >= 0.0 else -found.outward[n]
            nx, ny = _normal(screen, found.tail[n], found.head[n], away)
            height_above = x * nx + y * ny
            far = 0.5 * (1.0 + after)
            push = BESIDE if (far - 1.0) * height_above < BESIDE else 0.0
            far_x = u + far * x + push * nx
            far_y = v + far * y + push * ny
            near_x = u
            near_y = v
            near_face = np.int64(ids[row, column])
            if abs(height_above) < BESIDE:
                near_x = middle_x - BESIDE * nx
                near_y = middle_y - BESIDE * ny
                far_x = middle_x + BESIDE * nx
                far_y = middle_y + BESIDE * ny
            elif before > 0.0:
                near = 0.5 * (1.0 + before)
                push = BESIDE if (1.0 - near) * height_above < BESIDE else 0.0
                near_x = u + near * x - push * nx
                near_y = v + near * y - push * ny
            if near_x != u or near_y != v:
                near_face = np.int64(nearest_face(on_screen, tiles, near_x, near_y)[0])
            far_face = np.int64(nearest_face(on_screen, tiles, far_x, far_y)[0])
            if found.weight[n] >= 0.0:
                inner[n, 0], inner[n, 1], outer[n, 0], outer[n, 1] = near_x, near_y, far_x, far_y
                inner_face[n], outer_face[n] = near_face, far_face
            else:
                inner[n, 0], inner[n, 1], outer[n, 0], outer[n, 1] = far_x, far_y, near_x, near_y
                inner_face[n], outer_face[n] = far_face, near_face


@jit_inline
def _others_on_ray(screen, found, first, last, n, u, v, x, y):
    """Where the ray from (u, v) through fragment n's middle, (x, y) away, last meets another
    fragment before it, and first one, or the pixel's border, after it; 0 if there is none before.
    """
    reach = greater(abs(x), abs(y))
    before = 0.0
    after = 0.5 / reach if reach > 0.0 else 1.0
    for other in range(first, last):
        if other != n:
            at = _crossing(screen, found, other, u, v, x, y)
            if -TOUCHING <= at < 1.0:
                before = greater(greater(before, at), TOUCHING)
            elif at > 1.0:
                after = lesser(after, at)
    return before, after


@jit_inline
def _normal(screen, tail, head, sign):
    """The unit normal (dy, -dx) of an edge, times a sign."""
    dx = screen[head, 0] - screen[tail, 0]
    dy = screen[head, 1] - screen[tail, 1]
    scale = sign / np.sqrt(dx * dx + dy * dy)
    return dy * scale, -dx * scale


@jit_inline
def _crossing(screen, found, n, u, v, x, y):
    """Where a ray from (u, v) along (x, y) meets edge fragment n, in lengths of (x, y); -1 if it
    does not.
    """
    tail = found.tail[n]
    head = found.head[n]
    px = screen[tail, 0] - u
    py = screen[tail, 1] - v
    dx = screen[head, 0] - screen[tail, 0]
    dy = screen[head, 1] - screen[tail, 1]
    across = x * dy - y * dx
    if across == 0.0:
        return -1.0
    on_edge = -(x * py - y * px) / across
    if on_edge < found.span[n, 0] or on_edge > found.span[n, 1]:
        return -1.0
    return (px * dy - py * dx) / across


@jit_inline
def _next_border(at, step, t):
    """The parameter at which a coordinate next meets a whole number."""
    if step == 0.0:
        return np.inf
    here = at + t * step
    border = np.floor(here) + 1.0 if step > 0.0 else np.ceil(here) - 1.0
    then = (border - at) / step
    if then <= t:
        then = (border + (1.0 if step > 0.0 else -1.0) - at) / step
    return then
