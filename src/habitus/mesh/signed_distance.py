"""Points against a surface: closest triangle and true signed distance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.mesh.closest import closest_points
from habitus.mesh.triangles import barycentric_coordinates, triangle_normals


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
