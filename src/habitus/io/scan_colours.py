"""Colours of scans as trimesh has read them: of vertices and points, or of a picture laid on a
mesh.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.observe.srgb import linear_from_srgb

SAMPLED = 400_000
"""Places on a mesh at which its picture is looked up: pictures show more than vertices do."""

Coloured = tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]]


def part_colours(
    part: object, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], linear: bool
) -> Coloured | None:
    """Places (in the file's unit and axes) and linear colours there, 0 to 1; None where a part has
    none.

    linear: vertices' colours are linear light already, as glTF has them; other files and all
    pictures hold sRGB.
    """
    visual = getattr(part, "visual", None)
    picture = _picture(getattr(visual, "material", None))
    uv = getattr(visual, "uv", None)
    if picture is not None and uv is not None and len(uv) == len(vertices) and len(faces):
        return _from_picture(vertices, faces, np.asarray(uv, dtype=float), picture)
    own = getattr(part, "colors", None)  # of a cloud
    if own is None and getattr(visual, "kind", None) == "vertex":
        own = visual.vertex_colors  # pyright: ignore
    if own is None:  # of a mesh that has a material without a picture
        own = (getattr(visual, "vertex_attributes", None) or {}).get("color")
    if own is None or len(own) != len(vertices) or not len(vertices):
        return None
    values = np.asarray(own)[:, :3]
    values = values / 255.0 if values.dtype.kind in "ui" else values.astype(float)
    return vertices, values if linear else linear_from_srgb(values)


def _picture(material: Any) -> np.ndarray | None:
    """The bytes (H, W, 3) of a material's picture."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return None if image is None else np.asarray(image.convert("RGB"))


def _from_picture(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, picture: np.ndarray
) -> Coloured:
    """Places evenly all over a mesh, and the pixels that lie there; row 0 of the picture is on
    top.
    """
    corners = vertices[faces]
    rng = np.random.default_rng(0)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    if not area.sum() > 0.0:
        return vertices[:0], vertices[:0]
    face = rng.choice(len(faces), SAMPLED, p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), SAMPLED)
    at = np.einsum("nk,nkc->nc", share, uv[faces[face]]) % 1.0
    rows = np.minimum(((1.0 - at[:, 1]) * len(picture)).astype(int), len(picture) - 1)
    columns = np.minimum((at[:, 0] * picture.shape[1]).astype(int), picture.shape[1] - 1)
    return np.einsum("nk,nkc->nc", share, corners[face]), linear_from_srgb(
        picture[rows, columns] / 255.0
    )
