"""Vertices doubled along the seams of a texture, for formats in which a vertex has one place on the texture."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel

_NAMES = (("uv", "uv_faces"), ("vt", "ft"))  # ours, and those of SMPL-family files


@dataclass(frozen=True)
class Seams:
    """The mesh as it is written: N vertices, each a copy of the body's vertex ``source``; ``uv`` from below left."""

    source: Int[np.ndarray, " N"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "N 2"] | None = None


def seams_of(body: BodyModel) -> Seams:
    """The body's own vertices and faces, doubled at seams where it has texture coordinates that fit its faces."""
    found = _coordinates(body.extras, len(body.faces))
    if found is None:
        return Seams(np.arange(body.num_vertices), body.faces)
    uv, uv_faces = found
    corners = np.stack([body.faces.ravel(), uv_faces.ravel()], axis=1)
    pairs, place = np.unique(corners, axis=0, return_inverse=True)
    return Seams(pairs[:, 0], place.reshape(body.faces.shape), uv[pairs[:, 1]])


def _coordinates(extras: Mapping[str, np.ndarray], faces: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Texture coordinates (U, 2) and their faces (F, 3), where there are both and they agree."""
    for name, face_name in _NAMES:
        if name in extras and face_name in extras:
            uv, uv_faces = np.asarray(extras[name], np.float64), np.asarray(extras[face_name]).astype(np.int64)
            shaped = uv.ndim == 2 and uv.shape[1] == 2 and len(uv) and uv_faces.shape == (faces, 3)
            if shaped and np.isfinite(uv).all() and 0 <= uv_faces.min() <= uv_faces.max() < len(uv):
                return uv, uv_faces
    return None
