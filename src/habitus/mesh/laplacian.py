"""Laplacians of triangle meshes, and harmonic functions, which fill holes smoothly."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import splu

from habitus.mesh.normals import face_normals

_MAX_HALF_COTANGENT = 10.0  # of a face; beyond it all its cotangents are scaled down alike
_FAINT = 1e-9  # holds pieces of the mesh of which nothing is seen at zero


def cotangent_laplacian(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    share: Float[np.ndarray, " F"] | None = None,
) -> tuple[csc_array, Float[np.ndarray, " V"]]:
    """The cotangent Laplacian (V, V; positive semidefinite) and the areas of vertices, m^2: a third
    of their faces'.

    ``share``: how much each face counts in the Laplacian.
    """
    count = len(vertices)
    corners = vertices[faces]
    double = np.maximum(np.linalg.norm(face_normals(vertices, faces), axis=1), 1e-12)
    ahead, behind = np.roll(corners, -1, 1) - corners, np.roll(corners, 1, 1) - corners
    half = 0.5 * (ahead * behind).sum(2) / double[:, None]
    half *= (_MAX_HALF_COTANGENT / np.maximum(np.abs(half).max(1), _MAX_HALF_COTANGENT))[:, None]
    if share is not None:
        half *= share[:, None]
    i, j = np.roll(faces, -1, 1).ravel(), np.roll(faces, 1, 1).ravel()
    values = np.concatenate([-half, -half, half, half], None)
    table = (values, (np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])))
    area = np.bincount(faces.ravel(), np.repeat(double / 6.0, 3), count)
    return csc_array(coo_array(table, shape=(count, count))), np.maximum(area, 1e-9)


def fill_holes(
    laplacian: csr_array, seen: Bool[np.ndarray, " V"], values: Float[np.ndarray, "V ..."]
) -> Float[np.ndarray, "V ..."]:
    """``values`` where vertices are ``seen``; elsewhere the mean of the neighbours' (harmonic),
    zero on pieces unseen.

    ``laplacian`` (V, V) is the mesh's graph Laplacian: degrees on the diagonal, -1 for neighbours.
    """
    if seen.all():
        return values
    hole = np.flatnonzero(~seen)
    known = np.flatnonzero(seen)
    flat = values.reshape(len(values), -1)
    out = flat.copy()
    out[hole] = -_inverse(laplacian, hole)(laplacian[hole][:, known] @ flat[known])
    return out.reshape(values.shape)


def eliminate_holes(laplacian: csr_array, seen: Bool[np.ndarray, " V"]) -> csr_array:
    """The graph Laplacian (V, V) of the vertices that are ``seen``: its quadratic form is the whole
    one's least over values in the holes. Rows and columns of holes are zero.
    """
    hole = np.flatnonzero(~seen)
    known = np.flatnonzero(seen)
    if not len(hole):
        return laplacian
    across = laplacian[hole][:, known].tocsc()
    border = np.flatnonzero(np.diff(across.indptr))
    reach = across[:, border].toarray()
    bridges = csr_array(reach.T @ _inverse(laplacian, hole)(reach))
    place = csr_array(
        (np.ones(len(border)), (known[border], np.arange(len(border)))), (len(seen), len(border))
    )
    kept = diags_array(seen.astype(float))
    return (kept @ laplacian @ kept - place @ bridges @ place.T).tocsr()


def _inverse(
    laplacian: csr_array, hole: Int[np.ndarray, " n"]
) -> Callable[[np.ndarray], np.ndarray]:
    """Solves the Laplace equation in holes."""
    return splu((laplacian[hole][:, hole] + _FAINT * eye_array(len(hole))).tocsc()).solve
