"""Texture seams and polygons of a body, from its quads or from the coordinates of its file."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.surface_files import Seams, doubled_vertices, texture_seams

_NAMES = (("uv", "uv_faces"), ("vt", "ft"))  # ours, and those of SMPL-family files


def seams_of(body: BodyModel) -> Seams:
    """The body's own vertices and faces, doubled at seams where it has texture coordinates that fit
    its faces.
    """
    if body.mesh is not None and (seams := texture_seams(body.faces, body.mesh)) is not None:
        return seams
    extras = _coordinates(body.extras, len(body.faces))
    return (
        Seams(np.arange(body.num_vertices), body.faces)
        if extras is None
        else doubled_vertices(body.faces, *extras)
    )


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
