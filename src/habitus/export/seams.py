"""Vertices doubled along the seams of a texture, for formats in which a vertex has one place on the
texture.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.mesh import BodyMesh
from habitus.body.model import BodyModel

_NAMES = (("uv", "uv_faces"), ("vt", "ft"))  # ours, and those of SMPL-family files


@dataclass(frozen=True)
class Seams:
    """The mesh as it is written: N vertices, each a copy of the body's vertex ``source``; ``uv``
    from below left.
    """

    source: Int[np.ndarray, " N"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "N 2"] | None = None


def seams_of(body: BodyModel) -> Seams:
    """The body's own vertices and faces, doubled at seams where it has texture coordinates that fit
    its faces.
    """
    if body.mesh is not None and (found := seams_of_mesh(body.faces, body.mesh)) is not None:
        return found
    extras = _coordinates(body.extras, len(body.faces))
    return (
        Seams(np.arange(body.num_vertices), body.faces)
        if extras is None
        else _doubled(body.faces, *extras)
    )


def seams_of_mesh(faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None) -> Seams | None:
    """The seams of faces that are a body's quads cut in two; None where they are not, or nothing is
    known of quads.
    """
    uv_faces = None if mesh is None else mesh.triangle_uv(faces)
    return None if mesh is None or uv_faces is None else _doubled(faces, mesh.uv, uv_faces)


@dataclass(frozen=True)
class Polygons:
    """Faces of n corners (F, n), quads or triangles, and rows of ``uv`` for their corners where the
    body has them.
    """

    corners: Int[np.ndarray, "F n"]
    uv: Float[np.ndarray, "N 2"] | None = None
    uv_corners: Int[np.ndarray, "F n"] | None = None


def polygons_of(body: BodyModel) -> Polygons:
    """The body's quads where it has them, else its triangles: for formats whose faces have their
    own corners.
    """
    if body.mesh is not None and body.mesh.triangle_uv(body.faces) is not None:
        return Polygons(body.mesh.quads, body.mesh.uv, body.mesh.quad_uv)
    extras = _coordinates(body.extras, len(body.faces))
    return Polygons(body.faces) if extras is None else Polygons(body.faces, *extras)


def _doubled(faces: np.ndarray, uv: np.ndarray, uv_faces: np.ndarray) -> Seams:
    corners = np.stack([faces.ravel(), uv_faces.ravel()], axis=1)
    pairs, place = np.unique(corners, axis=0, return_inverse=True)
    return Seams(pairs[:, 0], place.reshape(faces.shape), uv[pairs[:, 1]])


def _coordinates(
    extras: Mapping[str, np.ndarray], faces: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Texture coordinates (U, 2) and their faces (F, 3), where there are both and they agree."""
    for name, face_name in _NAMES:
        if name in extras and face_name in extras:
            uv = np.asarray(extras[name], np.float64)
            uv_faces = np.asarray(extras[face_name]).astype(np.int64)
            shaped = uv.ndim == 2 and uv.shape[1] == 2 and len(uv) and uv_faces.shape == (faces, 3)
            if shaped and np.isfinite(uv).all() and 0 <= uv_faces.min() <= uv_faces.max() < len(uv):
                return uv, uv_faces
    return None
