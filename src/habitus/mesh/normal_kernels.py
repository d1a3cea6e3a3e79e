"""Unit normals of vertices and their VJP, compiled; `array_normals.unit_sums` is the reference in
array operations.

Faces' normals are twice as long as their areas, so that their sum around a vertex is weighted by
area.
"""

import numpy as np

from habitus.kernels.jit import jit_inline, jit_noalloc


@jit_noalloc
def sum_face_normals(vertices, faces, totals):
    """Add to totals (V, 3), float64, the normals of the faces around each vertex."""
    for f in range(len(faces)):
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        ux, uy, uz, vx, vy, vz = _sides(vertices, a, b, c)
        x = uy * vz - uz * vy
        y = uz * vx - ux * vz
        z = ux * vy - uy * vx
        for corner in (a, b, c):
            totals[corner, 0] += x
            totals[corner, 1] += y
            totals[corner, 2] += z


@jit_noalloc
def normalize(totals, tiny, normals):
    """Write totals (V, 3) at unit length; 0 where the square of the length is not above `tiny`."""
    for v in range(len(totals)):
        x = totals[v, 0]
        y = totals[v, 1]
        z = totals[v, 2]
        squared = x * x + y * y + z * z
        scale = 1.0 / np.sqrt(squared) if squared > tiny else 0.0
        normals[v, 0], normals[v, 1], normals[v, 2] = x * scale, y * scale, z * scale


@jit_noalloc
def vertex_normals_vjp(vertices, faces, totals, tiny, cotangent, out):
    """Add to out (V, 3) the cotangent of vertices, given that of unit normals.

    totals: of `sum_face_normals`; their own cotangents are written there.
    """
    for v in range(len(totals)):
        x = totals[v, 0]
        y = totals[v, 1]
        z = totals[v, 2]
        squared = x * x + y * y + z * z
        scale = 1.0 / np.sqrt(squared) if squared > tiny else 0.0
        x = x * scale
        y = y * scale
        z = z * scale
        gx = np.float64(cotangent[v, 0])
        gy = np.float64(cotangent[v, 1])
        gz = np.float64(cotangent[v, 2])
        along = gx * x + gy * y + gz * z
        totals[v, 0] = (gx - along * x) * scale
        totals[v, 1] = (gy - along * y) * scale
        totals[v, 2] = (gz - along * z) * scale
    for f in range(len(faces)):
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        ux, uy, uz, vx, vy, vz = _sides(vertices, a, b, c)
        x = totals[a, 0] + totals[b, 0] + totals[c, 0]
        y = totals[a, 1] + totals[b, 1] + totals[c, 1]
        z = totals[a, 2] + totals[b, 2] + totals[c, 2]
        px = vy * z - vz * y
        py = vz * x - vx * z
        pz = vx * y - vy * x
        qx = y * uz - z * uy
        qy = z * ux - x * uz
        qz = x * uy - y * ux
        _add(out, b, px, py, pz)
        _add(out, c, qx, qy, qz)
        _add(out, a, -px - qx, -py - qy, -pz - qz)


@jit_inline
def _sides(vertices, a, b, c):
    """The sides of a face that begin at its first corner."""
    x = np.float64(vertices[a, 0])
    y = np.float64(vertices[a, 1])
    z = np.float64(vertices[a, 2])
    return (
        vertices[b, 0] - x,
        vertices[b, 1] - y,
        vertices[b, 2] - z,
        vertices[c, 0] - x,
        vertices[c, 1] - y,
        vertices[c, 2] - z,
    )


@jit_inline
def _add(to, row, x, y, z):
    """Add three numbers to a row."""
    to[row, 0] += x
    to[row, 1] += y
    to[row, 2] += z
