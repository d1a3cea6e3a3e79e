"""Which probes lie in foreign tetrahedra of a deformed cage, and the closest points of triangles
around vertices.
"""

import numpy as np

from habitus.kernels.jit import jit


@jit
def embed(nodes, corners, weights, out):
    """Points (P, 3) from the corners (P, 4) of their tetrahedra."""
    for p in range(len(corners)):
        for c in range(3):
            total = 0.0
            for a in range(4):
                total += weights[p, a] * nodes[corners[p, a], c]
            out[p, c] = total


@jit
def vertex_normals(vertices, faces, out):
    """Unit normals (V, 3), weighted by area."""
    out[:] = 0.0
    for f in range(len(faces)):
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        x = vertices[b, 0] - vertices[a, 0]
        y = vertices[b, 1] - vertices[a, 1]
        z = vertices[b, 2] - vertices[a, 2]
        p = vertices[c, 0] - vertices[a, 0]
        q = vertices[c, 1] - vertices[a, 1]
        r = vertices[c, 2] - vertices[a, 2]
        nx = y * r - z * q
        ny = z * p - x * r
        nz = x * q - y * p
        for v in (a, b, c):
            out[v, 0] += nx
            out[v, 1] += ny
            out[v, 2] += nz
    for v in range(len(out)):
        length = (out[v, 0] ** 2 + out[v, 1] ** 2 + out[v, 2] ** 2) ** 0.5
        for c in range(3):
            out[v, c] /= max(length, 1e-300)


@jit
def fill_grid(nodes, tets, low, cell, size):
    """Tetrahedra by the cells (of `size` cells an axis) that their boxes touch: starts of cells,
    and the lists.
    """
    counts = np.zeros(size[0] * size[1] * size[2] + 1, np.int64)
    spans = np.empty((len(tets), 6), np.int32)
    for t in range(len(tets)):
        for c in range(3):
            least = most = nodes[tets[t, 0], c]
            for a in range(1, 4):
                value = nodes[tets[t, a], c]
                least = min(least, value)
                most = max(most, value)
            spans[t, c] = min(max(int((least - low[c]) / cell), 0), size[c] - 1)
            spans[t, 3 + c] = min(max(int((most - low[c]) / cell), 0), size[c] - 1)
    for t in range(len(tets)):
        for i in range(spans[t, 0], spans[t, 3] + 1):
            for j in range(spans[t, 1], spans[t, 4] + 1):
                for k in range(spans[t, 2], spans[t, 5] + 1):
                    counts[(i * size[1] + j) * size[2] + k + 1] += 1
    starts = np.cumsum(counts)
    lists = np.empty(starts[-1], np.int32)
    here = starts[:-1].copy()
    for t in range(len(tets)):
        for i in range(spans[t, 0], spans[t, 3] + 1):
            for j in range(spans[t, 1], spans[t, 4] + 1):
                for k in range(spans[t, 2], spans[t, 5] + 1):
                    n = (i * size[1] + j) * size[2] + k
                    lists[here[n]] = t
                    here[n] += 1
    return starts, lists


@jit
def inside(nodes, tet, point, weights):
    """Whether a point lies in a tetrahedron that is not inverted; fills its barycentric weights
    (4,).
    """
    o0 = nodes[tet[0], 0]
    o1 = nodes[tet[0], 1]
    o2 = nodes[tet[0], 2]
    a0 = nodes[tet[1], 0] - o0
    a1 = nodes[tet[1], 1] - o1
    a2 = nodes[tet[1], 2] - o2
    b0 = nodes[tet[2], 0] - o0
    b1 = nodes[tet[2], 1] - o1
    b2 = nodes[tet[2], 2] - o2
    c0 = nodes[tet[3], 0] - o0
    c1 = nodes[tet[3], 1] - o1
    c2 = nodes[tet[3], 2] - o2
    p0 = point[0] - o0
    p1 = point[1] - o1
    p2 = point[2] - o2
    x0 = b1 * c2 - b2 * c1
    x1 = b2 * c0 - b0 * c2
    x2 = b0 * c1 - b1 * c0
    det = a0 * x0 + a1 * x1 + a2 * x2
    if det <= 1e-18:
        return False
    weights[1] = (p0 * x0 + p1 * x1 + p2 * x2) / det
    if weights[1] < 0:
        return False
    y0 = a1 * p2 - a2 * p1
    y1 = a2 * p0 - a0 * p2
    y2 = a0 * p1 - a1 * p0
    weights[2] = (c0 * y0 + c1 * y1 + c2 * y2) / det
    weights[3] = -(b0 * y0 + b1 * y1 + b2 * y2) / det
    weights[0] = 1 - weights[1] - weights[2] - weights[3]
    return weights[0] >= 0 and weights[2] >= 0 and weights[3] >= 0


@jit
def foreign(nodes, rest, tets, centres, grid, probes, homes, held, held_tets, far, where):
    """Rest places `where` (P, 3) of probes in tetrahedra whose rest centre is `far` from the
    probe's home at rest.

    True for probes that lie in one. Those that are held, in a tetrahedron that is held, are left
    out.
    """
    starts, lists, low, cell, size = grid
    weights = np.empty(4)
    found = np.zeros(len(probes), np.bool_)
    for p in range(len(probes)):
        i = int((probes[p, 0] - low[0]) / cell)
        j = int((probes[p, 1] - low[1]) / cell)
        k = int((probes[p, 2] - low[2]) / cell)
        if min(i, j, k) < 0 or i >= size[0] or j >= size[1] or k >= size[2]:
            continue
        n = (i * size[1] + j) * size[2] + k
        for e in range(starts[n], starts[n + 1]):
            t = lists[e]
            if held[p] and held_tets[t]:
                continue
            away = 0.0
            for c in range(3):
                away += (centres[t, c] - homes[p, c]) ** 2
            if away > far * far and inside(nodes, tets[t], probes[p], weights):
                for c in range(3):
                    where[p, c] = 0.0
                    for a in range(4):
                        where[p, c] += weights[a] * rest[tets[t, a], c]
                found[p] = True
                break
    return found


@jit
def closest_around(points, nearest, vertices, faces, starts, around, out):
    """Closest points `out` (P, 3) on the triangles around the `nearest` vertices (P,)."""
    trial = np.empty(3)
    for p in range(len(points)):
        best = 1e300
        for e in range(starts[nearest[p]], starts[nearest[p] + 1]):
            face = faces[around[e]]
            _closest(points[p], vertices[face[0]], vertices[face[1]], vertices[face[2]], trial)
            away = (
                (trial[0] - points[p, 0]) ** 2
                + (trial[1] - points[p, 1]) ** 2
                + (trial[2] - points[p, 2]) ** 2
            )
            if away < best:
                best = away
                out[p, 0], out[p, 1], out[p, 2] = trial[0], trial[1], trial[2]


@jit
def _dot(a, b, c, d):
    return (
        (a[0] - b[0]) * (c[0] - d[0])
        + (a[1] - b[1]) * (c[1] - d[1])
        + (a[2] - b[2]) * (c[2] - d[2])
    )


@jit
def _closest(p, a, b, c, out):
    """Closest point of a triangle (Ericson 2005, 5.1.5)."""
    d1 = _dot(b, a, p, a)
    d2 = _dot(c, a, p, a)
    d3 = _dot(b, a, p, b)
    d4 = _dot(c, a, p, b)
    d5 = _dot(b, a, p, c)
    d6 = _dot(c, a, p, c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    if d1 <= 0 and d2 <= 0:
        v = 0.0
        w = 0.0
    elif d3 >= 0 and d4 <= d3:
        v = 1.0
        w = 0.0
    elif d6 >= 0 and d5 <= d6:
        v = 0.0
        w = 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        v = d1 / (d1 - d3)
        w = 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        v = 0.0
        w = d2 / (d2 - d6)
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1 - w
    else:
        v = vb / (va + vb + vc)
        w = vc / (va + vb + vc)
    for i in range(3):
        out[i] = a[i] + v * (b[i] - a[i]) + w * (c[i] - a[i])
