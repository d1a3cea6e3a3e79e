"""The closest face of a mesh to each of some points, compiled: faces are looked at that may be
closest, and no others.

Faces that follow each other in a mesh lie close together: a ball around `GROUP` of them tells how
near any of them can be, then one around a face, and only what is left is measured.
"""

import math

import numpy as np

from habitus.kernels.jit import jit, jit_inline

GROUP = 32


@jit
def find_closest(points, vertices, faces, slack, found, closest):
    """Into found (N,) the first face that is no further from its point than the nearest face and
    `slack` (m), into closest (N, 3) its nearest point.

    Faces without area are passed over, unless there are no others.
    """
    balls = np.empty((len(faces), 4))
    groups = np.empty(((len(faces) + GROUP - 1) // GROUP, 4))
    if not enclose_faces(vertices, faces, balls, False):
        enclose_faces(vertices, faces, balls, True)
    enclose_groups(balls, groups)
    near = np.empty(3)
    for i in range(len(points)):
        limit = math.inf
        for g in range(len(groups)):
            if groups[g, 3] >= 0.0:
                limit = min(limit, away(points[i], groups[g]) + groups[g, 3] + slack)
        for first_only in (False, True):  # how near the nearest is, then the first that is as near
            for g in range(len(groups)):
                if may_reach(points[i], groups[g], limit):
                    for f in range(g * GROUP, min((g + 1) * GROUP, len(faces))):
                        if may_reach(points[i], balls[f], limit):
                            distance = nearest_in_face(points[i], vertices, faces[f], near)
                            if first_only and distance <= limit:
                                found[i], limit = f, -math.inf
                                for k in range(3):
                                    closest[i, k] = near[k]
                            elif not first_only:
                                limit = min(limit, distance + slack)


@jit_inline
def may_reach(p, ball, limit):
    """Whether something in a ball may be no further from a point than the limit."""
    return ball[3] >= 0.0 and away(p, ball) - ball[3] <= limit


@jit_inline
def enclose_faces(vertices, faces, balls, flat):
    """Middle and radius of each face; a negative radius where it has no area, unless `flat` ones
    count. Whether any counts.
    """
    any_counts = False
    for f in range(len(faces)):
        a = vertices[faces[f, 0]]
        b = vertices[faces[f, 1]]
        c = vertices[faces[f, 2]]
        for k in range(3):
            balls[f, k] = (a[k] + b[k] + c[k]) / 3.0
        ux = b[0] - a[0]
        uy = b[1] - a[1]
        uz = b[2] - a[2]
        vx = c[0] - a[0]
        vy = c[1] - a[1]
        vz = c[2] - a[2]
        area = (uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2
        reach = max(away(a, balls[f]), away(b, balls[f]), away(c, balls[f]))
        counts = flat or area > 0.0
        balls[f, 3] = reach * (1.0 + 1e-12) + 1e-12 if counts else -1.0
        any_counts = any_counts or counts
    return any_counts


@jit_inline
def enclose_groups(balls, groups):
    """A ball around the faces of each group; a negative radius where none counts."""
    for g in range(len(groups)):
        x = 0.0
        y = 0.0
        z = 0.0
        radius = -1.0
        count = 0
        run = range(g * GROUP, min((g + 1) * GROUP, len(balls)))
        for f in run:
            if balls[f, 3] >= 0.0:
                x = x + balls[f, 0]
                y = y + balls[f, 1]
                z = z + balls[f, 2]
                count = count + 1
        groups[g, 0], groups[g, 1], groups[g, 2] = (
            x / max(count, 1),
            y / max(count, 1),
            z / max(count, 1),
        )
        for f in run:
            if balls[f, 3] >= 0.0:
                radius = max(radius, away(balls[f], groups[g]) + balls[f, 3])
        groups[g, 3] = radius


@jit_inline
def away(p, q):
    """Distance of two points."""
    return math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


@jit_inline
def nearest_in_face(p, vertices, face, near):
    """Distance of a point from a face, whose nearest point goes into near (3,) (Ericson 2005,
    5.1.5).
    """
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    d1 = 0.0
    d2 = 0.0
    d3 = 0.0
    d4 = 0.0
    d5 = 0.0
    d6 = 0.0
    for k in range(3):
        ab = b[k] - a[k]
        ac = c[k] - a[k]
        d1 = d1 + ab * (p[k] - a[k])
        d2 = d2 + ac * (p[k] - a[k])
        d3 = d3 + ab * (p[k] - b[k])
        d4 = d4 + ac * (p[k] - b[k])
        d5 = d5 + ab * (p[k] - c[k])
        d6 = d6 + ac * (p[k] - c[k])
    in_a = d3 * d6 - d5 * d4
    in_b = d5 * d2 - d1 * d6
    in_c = d1 * d4 - d3 * d2
    v = 0.0
    w = 0.0  # shares of b and c
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0
    elif in_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = part(d1, d1 - d3)
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif in_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = part(d2, d2 - d6)
    elif in_a <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = part(d4 - d3, (d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v = part(in_b, in_a + in_b + in_c)
        w = part(in_c, in_a + in_b + in_c)
    for k in range(3):
        near[k] = a[k] + v * (b[k] - a[k]) + w * (c[k] - a[k])
    return away(p, near)


@jit_inline
def part(share, whole):
    """share / whole, 0 of nothing."""
    return share / whole if whole > 0.0 else 0.0
