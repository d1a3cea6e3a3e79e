"""Points and surfaces: triangles, the closest of them, signed distance, points far from each other.

A place on a triangle with corners a, b, c is u a + v b + w c with u + v + w = 1; (u, v, w) are its
barycentric coordinates. Where several triangles are equally close, rounding must not choose.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import cross
from habitus.types import Array


def triangle_normals(corners: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """(b - a) x (c - a) of triangles with these corners (m; corner, coordinate): normals of twice
    the area (m^2) as length, on the side from which the corners run counter-clockwise.
    """
    first = corners[..., 0, :]
    return cross(corners[..., 1, :] - first, corners[..., 2, :] - first)


def at_barycentrics(
    values: Float[np.ndarray, "V C"],
    corners: Int[np.ndarray, "N 3"],
    barycentric: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N C"]:
    """Values of vertices interpolated at N places: ``corners`` are the three vertices of each
    place's triangle.
    """
    return np.einsum("nk,nkc->nc", barycentric, values[corners])


def barycentric_coordinates(
    points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N 3 3"]
) -> Float[np.ndarray, "N 3"]:
    """Barycentric coordinates of N points, each in the plane of its triangle (corner,
    coordinate).
    """
    e = corners[:, 1] - corners[:, 0]
    f = corners[:, 2] - corners[:, 0]
    p = points - corners[:, 0]
    ee = (e * e).sum(1)
    ef = (e * f).sum(1)
    ff = (f * f).sum(1)
    pe = (p * e).sum(1)
    pf = (p * f).sum(1)
    determinant = ee * ff - ef * ef + 1e-300  # a triangle without area: no division by zero
    b = (ff * pe - ef * pf) / determinant
    c = (ee * pf - ef * pe) / determinant
    return np.stack([1 - b - c, b, c], axis=1)


SAME = 1e-6
"""Metres: triangles whose distances from a point differ by less are equally close."""


def closest_faces(
    points: Float[np.ndarray, "M 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
) -> Int[np.ndarray, " M"]:
    """The face closest to each point; of equally close ones the first in the mesh.

    A point above an edge or a corner is equally far from all faces that meet there. Faces without
    area are passed over as long as there are others.
    """
    return closest_points(points, vertices, faces, SAME)[0]


def closest_points(
    points: Float[np.ndarray, "M 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    same: float = 0.0,
) -> tuple[Int[np.ndarray, " M"], Float[np.ndarray, "M 3"]]:
    """The closest face to each point and the place on it that is closest; faces that differ by up
    to ``same`` metres count as equally close.
    """
    from habitus.mesh.closest_kernels import find_closest

    given = (np.ascontiguousarray(each, dtype=np.float64) for each in (points, vertices))
    triangles = np.empty(len(points), dtype=np.int64)
    closest = np.empty((len(points), 3))
    find_closest(
        *given, np.ascontiguousarray(faces, dtype=np.int64), float(same), triangles, closest
    )
    return triangles, closest


@dataclass(frozen=True)
class SurfacePoints:
    """Where each of N points lies relative to a closed, outward oriented mesh (metres).

    distance: (N,) positive outside. triangle: (N,) closest face. barycentric: (N, 3) of the closest
    point in it. direction: (N, 3) unit gradient of the signed distance with respect to the point.
    """

    distance: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray
    direction: np.ndarray


def signed_distance(
    points: Float[np.ndarray, "N 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
) -> SurfacePoints:
    """Signed distance of ``points`` to the surface, r(x, S) of MoSh eq. 4.

    The sign comes from the angle-weighted pseudonormal at the closest point, interpolated between
    corners.
    """
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    triangle, closest = closest_points(points, vertices, faces)
    corners = vertices[faces[triangle]]
    barycentric = barycentric_coordinates(closest, corners)
    used, inverse = np.unique(faces[triangle], return_inverse=True)
    pseudonormals = _angle_weighted_normals(vertices, faces, used)[inverse.reshape(-1, 3)]
    face_normal = triangle_normals(corners)
    face_normal /= np.linalg.norm(face_normal, axis=1, keepdims=True) + 1e-300
    inside_face = barycentric.min(axis=1) > 1e-9
    normal = np.where(
        inside_face[:, None], face_normal, np.einsum("nk,nkd->nd", barycentric, pseudonormals)
    )
    offset = points - closest
    sign = np.where(np.einsum("nd,nd->n", offset, normal) < 0, -1.0, 1.0)
    distance = sign * np.linalg.norm(offset, axis=1)
    touching = np.abs(distance) < 1e-9
    direction = np.where(
        touching[:, None], face_normal, offset / np.where(touching, 1.0, distance)[:, None]
    )
    return SurfacePoints(distance, triangle, barycentric, direction)


def _angle_weighted_normals(
    vertices: np.ndarray, faces: np.ndarray, used: np.ndarray
) -> np.ndarray:
    """Angle-weighted pseudonormals of the vertices ``used`` (sorted): (len(used), 3), not
    normalised.
    """
    marked = np.zeros(len(vertices), dtype=bool)
    marked[used] = True
    touching = faces[marked[faces].any(axis=1)]
    corners = vertices[touching]
    normal = triangle_normals(corners)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-300
    total = np.zeros((len(vertices), 3))
    for k in range(3):
        a = corners[:, (k + 1) % 3] - corners[:, k]
        b = corners[:, (k + 2) % 3] - corners[:, k]
        cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) + 1e-300)
        np.add.at(total, touching[:, k], np.arccos(np.clip(cosine, -1, 1))[:, None] * normal)
    return total[used]


def farthest_points(
    points: Float[np.ndarray, "N C"], count: int, first: int = 0
) -> Int[np.ndarray, " K"]:
    """Farthest-point sampling: ``count`` rows of ``points`` (at most N), beginning with ``first``;
    each next one is the row farthest from all chosen before it.
    """
    chosen = [first]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(nearest.argmax()))
    return np.array(chosen, np.int64)
