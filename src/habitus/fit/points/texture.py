"""The person's albedo on the body's texture: of each texel what the views show there, lit as it was
found.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import splu

from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.offsets import along_normals
from habitus.fit.points.appearance import Appearance, depth_of, look_up, moved
from habitus.fit.points.depth_settings import APPEARANCE, AppearanceSettings
from habitus.fit.points.prepared_views import PreparedView
from habitus.mesh.normals import vertex_normals
from habitus.observe.light import harmonics
from habitus.render import operators
from habitus.render.rasterize import rasterize
from habitus.render.triangles import Triangles


@dataclass(frozen=True, eq=False)
class Skin:
    """A body's full surface with linear albedo: of each vertex (V, 3), and a texture (S, S, 3)
    where it has one.
    """

    body: BodyModel
    vertex_albedo: Float[np.ndarray, "V 3"]
    texture: Float[np.ndarray, "S S 3"] | None


def bake(
    body: BodyModel,
    state: BodyState,
    views: tuple[PreparedView, ...],
    appearance: Appearance,
    size: int,
    offset: Float[np.ndarray, " V"] | None = None,
    settings: AppearanceSettings = APPEARANCE,
) -> Skin:
    """The albedo of the body at its full level of detail. offset: of the skin from the model
    (m).
    """
    fine = body.full or body
    albedo = np.exp(spread(body, np.log(appearance.albedo)))
    surfaces = fine(state.betas, state.pose, state.trans).vertices
    if offset is not None:
        surfaces = along_normals(surfaces, spread(body, offset[:, None])[:, 0], fine)
    uv_faces = None if fine.mesh is None else fine.mesh.triangle_uv(fine.faces)
    texture = None
    if fine.mesh is not None and uv_faces is not None:
        texture = _texture(
            fine, surfaces, views, appearance, albedo, (fine.mesh.uv, uv_faces), size, settings
        )
    brightest = float(np.percentile(albedo.max(1), 99.5))
    scale = settings.brightest / max(brightest, 1e-3)
    return Skin(
        fine, (albedo * scale).clip(0, 1), None if texture is None else (texture * scale).clip(0, 1)
    )


def spread(body: BodyModel, values: Float[np.ndarray, "V C"]) -> Float[np.ndarray, "W C"]:
    """The coarse vertices' values over the full mesh, smoothly between."""
    fine = body.full or body
    if fine is body or body.full_vertices is None:
        return values
    pairs = np.concatenate([fine.faces[:, [0, 1]], fine.faces[:, [1, 2]], fine.faces[:, [2, 0]]])
    count = fine.num_vertices
    rows = np.repeat(np.arange(len(pairs)), 2)
    step = sparse.csr_array(
        (np.tile([1.0, -1.0], len(pairs)), (rows, pairs.ravel())), (len(pairs), count)
    )
    known = np.zeros(count)
    known[body.full_vertices] = 1e3
    given = np.zeros((count, values.shape[1]))
    given[body.full_vertices] = 1e3 * values
    return splu((step.T @ step + sparse.diags_array(known + 1e-6)).tocsc()).solve(given)


def _texture(
    fine: BodyModel,
    surfaces: Float[np.ndarray, "K V 3"],
    views: tuple[PreparedView, ...],
    appearance: Appearance,
    albedo: Float[np.ndarray, "V 3"],
    chart: tuple[Float[np.ndarray, "U 2"], Int[np.ndarray, "F 3"]],
    size: int,
    settings: AppearanceSettings,
) -> Float[np.ndarray, "S S 3"]:
    pixel, face, share = _texels(*chart, size)
    corners = fine.faces[face]
    total = settings.vertex_weight * np.einsum("nk,nkc->nc", share, albedo[corners])
    weights = np.full(len(pixel), settings.vertex_weight)
    triangles = Triangles.of(fine.faces, num_vertices=fine.num_vertices)
    for k, view in enumerate(views):
        if view.colour_camera is None:
            continue
        vertices = surfaces[k]
        normals = np.einsum("nk,nkc->nc", share, vertex_normals(vertices, fine.faces)[corners])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        points = np.einsum("nk,nkc->nc", share, vertices[corners])
        camera = moved(view.colour_camera, appearance.shift.shift)
        colour, weight = look_up(
            view, camera, points, normals, depth_of(camera, vertices, triangles), settings
        )
        shade = (harmonics(torch.from_numpy(normals)).numpy() @ appearance.light).clip(
            settings.min_texture_shade
        )
        total += (weight**2)[:, None] * colour / shade
        weights += weight**2
    image = np.zeros((size * size, 3))
    image[pixel] = total / weights[:, None]
    covered = np.zeros(size * size, bool)
    covered[pixel] = True
    nearest = distance_transform_edt(
        ~covered.reshape(size, size), return_distances=False, return_indices=True
    )
    rows, columns = cast(np.ndarray, nearest)
    return image.reshape(size, size, 3)[rows, columns]


def _texels(
    uv: Float[np.ndarray, "U 2"], uv_faces: Int[np.ndarray, "F 3"], size: int
) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Texels that the surface covers (row 0 on top): number, face, barycentric coordinates."""
    flat = np.column_stack([uv * [1.0, -1.0] * size + [0.0, size], np.ones(len(uv))])
    screen = torch.from_numpy(np.ascontiguousarray(flat))
    triangles = Triangles.of(uv_faces, num_vertices=len(uv))
    ids = rasterize(screen, triangles, size, size, False, False).ids.reshape(-1)
    pixel = torch.nonzero(ids >= 0)[:, 0]
    points = torch.stack([pixel % size + 0.5, pixel // size + 0.5], 1).to(screen.dtype)
    face = ids[pixel]
    share = operators.barycentrics(screen, triangles.faces, face, points, False)
    return pixel.numpy(), face.numpy().astype(np.int64), share.numpy()
