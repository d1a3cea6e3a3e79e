"""A person drawn before the background, lit, and compared with what a view saw: residuals of E_C
(T eq. 4.4) and their derivatives.

    I - (alpha a h(n) L + (1 - alpha) I_background)

Derivatives are the renderer's own, of antialiased images: outlines move, albedo a is carried along,
normals n turn in the light L. Pixels where the surface turns away say where it ends: they count for
more, a large difference is believed there, and albedo does not follow them, as it would paint the
background on the person. At a level of the pyramid (T 4.6.1) a pixel is the mean of several.

`bake` writes the fitted albedo on the body's texture: of each texel what the views show there.
"""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import splu

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.offsets import along_normals
from habitus.fit.points.appearance import (
    Appearance,
    depth_of,
    eye_of,
    look_up,
    moved,
    to_linear,
)
from habitus.fit.points.depth_settings import APPEARANCE, AppearanceSettings, RgbdSettings
from habitus.fit.points.prepared_views import PreparedView
from habitus.fit.points.skin_offsets import SkinField
from habitus.mesh.normals import normal_jacobian, vertex_normals
from habitus.observe.camera import Camera
from habitus.observe.light import harmonics, harmonics_slope
from habitus.render import operators
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.jacobians.images import image_jacobian
from habitus.render.rasterize import rasterize
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec


@dataclass(frozen=True, eq=False)
class ColourLevel:
    """Linear colours (h, w, 3) around the person, means over ``factor`` x ``factor`` pixels: seen,
    and of the room.

    usable (h, w): 1 where no pixel is overexposed, else 0.
    """

    camera: Camera
    factor: int
    seen: Float[np.ndarray, "h w 3"]
    room: Float[np.ndarray, "h w 3"]
    usable: Float[np.ndarray, "h w"]

    @staticmethod
    def of(
        prepared: PreparedView,
        vertices: Float[np.ndarray, "V 3"],
        shift: Float[np.ndarray, " 3"],
        factor: int,
        settings: AppearanceSettings = APPEARANCE,
    ) -> "ColourLevel | None":
        """The neighbourhood of a surface in a view; None without colour of the person and of the
        empty room.
        """
        if (
            prepared.colour_camera is None
            or prepared.view.colour is None
            or prepared.view.background_colour is None
        ):
            return None
        camera = moved(prepared.colour_camera, shift)
        pixels = camera.project(torch.from_numpy(vertices))[0].numpy()
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(pixels.min(0)) - settings.margin, 0, size - factor).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + settings.margin, low + factor, size).astype(int)
        across, down = (high - low) // factor * factor
        part = (slice(low[1], low[1] + down), slice(low[0], low[0] + across))
        small = camera.replace(
            width=int(across) // factor,
            height=int(down) // factor,
            focal_length=camera.focal_length / factor,
            principal_point=(camera.principal_point - torch.from_numpy(low.astype(float))) / factor,
        )
        seen, room = (
            to_linear(image[part])
            for image in (prepared.view.colour, prepared.view.background_colour)
        )
        usable = (prepared.view.colour[part].max(-1) < settings.saturated)[..., None].astype(float)
        least = _means(usable, factor)[..., 0] > 1.0 - 1e-9
        return ColourLevel(
            small, factor, _means(seen, factor), _means(room, factor), least.astype(float)
        )

    def without(self, points: Float[np.ndarray, "N 3"], reach: float) -> "ColourLevel":
        """The level, its pixels not used within ``reach`` (m, at the points) of points."""
        pixels, depth = (each.numpy() for each in self.camera.project(torch.from_numpy(points)))
        column, row = np.floor(pixels).astype(int).T
        height, width = self.usable.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        away = np.ones((height, width), bool)
        away[row[inside], column[inside]] = False
        pixel = float(np.median(depth)) / float(self.camera.focal_length[0])
        used = np.asarray(distance_transform_edt(away)) * pixel > reach
        return replace(self, usable=self.usable * used)


def _means(image: Float[np.ndarray, "H W C"], factor: int) -> Float[np.ndarray, "h w C"]:
    height, width = (size // factor for size in image.shape[:2])
    return image.reshape(height, factor, width, factor, -1).mean((1, 3))


@dataclass(frozen=True, eq=False)
class Look:
    """What a person looks like: albedo (V, 3), light (9, 3) in the views' world, linear; shift (3,)
    of the colour camera (m).
    """

    albedo: Float[np.ndarray, "V 3"]
    light: Float[np.ndarray, "9 3"]
    shift: Float[np.ndarray, " 3"]

    @staticmethod
    def of(appearance: Appearance, settings: AppearanceSettings = APPEARANCE) -> "Look":
        """The look of light and albedo as they were found."""
        albedo = appearance.albedo.clip(settings.min_albedo, settings.max_albedo)
        return Look(albedo, appearance.light, appearance.shift.shift)


@dataclass(frozen=True, eq=False)
class ViewRows:
    """E_C of one view and channel, R pixels: residual, weight, and derivatives to betas, trans,
    pose, the channel's light and the camera's shift (in this order), and to the log albedo of
    vertices.
    """

    residual: Float[np.ndarray, " R"]
    weight: Float[np.ndarray, " R"]
    jacobian: Float[np.ndarray, "R n"]
    by_albedo: sparse.csr_array


@dataclass(frozen=True, eq=False)
class Moving:
    """A posed surface and how its vertices move: motion (3 V, M) with betas, trans and pose; along
    ``lift`` (3 V, V), which places normals, with the skin's offsets, which are basis (V, C) times
    the field's numbers; turning (3 V, 3 V): its normals with its vertices.
    """

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    motion: Float[np.ndarray, "V3 M"]
    lift: sparse.csr_array
    basis: Float[np.ndarray, "V C"]
    turning: sparse.csr_array

    @staticmethod
    def of(
        body: BodyModel, state: BodyState, k: int, field: SkinField, skin: Float[np.ndarray, " C"]
    ) -> "Moving":
        """That of view k."""
        motions = surface_jacobian(body, state.betas, state.pose[k], state.trans[k])
        vertices = np.ascontiguousarray(motions.surface.vertices)
        count = body.num_vertices
        by_betas, by_pose = (
            part.reshape(3 * count, -1) for part in (motions.vertices_betas, motions.vertices_pose)
        )
        motion = np.concatenate([by_betas, np.tile(np.eye(3), (count, 1)), by_pose], 1)
        normals = vertex_normals(vertices, body.faces)
        lift = sparse.csr_array(
            (normals.ravel(), np.repeat(np.arange(count), 3), np.arange(3 * count + 1))
        )
        vertices = field.seen(vertices, skin)
        turning = normal_jacobian(vertices, body.faces).tocsr()
        normals = vertex_normals(vertices, body.faces)
        return Moving(vertices, normals, motion, lift, field.basis, turning)

    def through(self, rows: sparse.csr_array) -> Float[np.ndarray, "R P"]:
        """Rows (R, 3 V) of derivatives by vertices as ones by betas, trans, pose and the field's
        numbers.
        """
        return np.concatenate([rows @ self.motion, (rows @ self.lift) @ self.basis], 1)

    def turned(self, some: Int[np.ndarray, " U"]) -> Float[np.ndarray, "U 3 P"]:
        """How the normals of some vertices move."""
        rows = (3 * some[:, None] + np.arange(3)).ravel()
        return self.through(self.turning[rows]).reshape(len(some), 3, -1)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A surface drawn before the background: its frame, the harmonics (V, 9) and the colours (V, 3)
    of its vertices, and the image less what was seen (h w, 3).
    """

    frame: Frame
    shape: Float[np.ndarray, "V 9"]
    values: Float[np.ndarray, "V 3"]
    residual: Float[np.ndarray, "HW 3"]

    @staticmethod
    def of(
        vertices: Float[np.ndarray, "V 3"],
        normals: Float[np.ndarray, "V 3"],
        triangles: Triangles,
        level: ColourLevel,
        look: Look,
        settings: AppearanceSettings,
    ) -> "Drawn":
        """In the light and albedo of ``look``."""
        shape = harmonics(torch.from_numpy(normals)).numpy()
        values = look.albedo * (shape @ look.light).clip(settings.min_drawn_shade)
        frame = draw(level.camera, torch.from_numpy(vertices), triangles)
        assert isinstance(frame, Frame)  # one camera, one surface
        image = frame.image(torch.from_numpy(values), torch.from_numpy(level.room)).numpy()
        return Drawn(frame, shape, values, (image - level.seen).reshape(-1, 3))

    def cost(
        self, level: ColourLevel, rim: Bool[np.ndarray, " HW"], settings: RgbdSettings
    ) -> float:
        """E_C of the view, robust; rim: pixels that count as the model's rim."""
        looks = settings.appearance
        weight = settings.colour * level.factor**2 / looks.noise**2 * level.usable.ravel()
        weight = weight * np.where(rim, settings.rim, 1.0)
        scale = np.where(rim, looks.rim_outlier, looks.outlier)[:, None]
        loss = self.residual**2 / (1.0 + (self.residual / scale) ** 2)
        return 0.5 * float(weight @ loss.sum(1))


def view_rows(
    moving: Moving,
    triangles: Triangles,
    level: ColourLevel,
    look: Look,
    settings: RgbdSettings,
    drawn: Drawn | None = None,
) -> list[ViewRows]:
    """The three channels' rows of one view; drawn: the surface, where that is known."""
    looks = settings.appearance
    if drawn is None:
        drawn = Drawn.of(moving.vertices, moving.normals, triangles, level, look, looks)
    frame, shape, values = drawn.frame, drawn.shape, drawn.values
    slope = harmonics_slope(torch.from_numpy(moving.normals)).numpy()
    points = torch.from_numpy(moving.vertices)
    room = torch.from_numpy(level.room)
    image_rows = image_jacobian(frame, torch.from_numpy(values), room)
    by_vertices = image_rows.to_vertices(level.camera, points)
    shown = image_rows.values.tocsr()
    pixels = np.flatnonzero(np.diff(shown.indptr))
    shown = shown[pixels]
    inner = ~rim_pixels(frame, level, moving, looks.rim_cosine)[pixels]
    usable = level.usable.ravel()[pixels] * np.where(inner, 1.0, settings.rim)
    shift = np.tile(matrix_from_rotvec(level.camera.rotation).numpy().T, (len(values), 1))
    corners = np.unique(shown.indices)
    rows = []
    turned = moving.turned(corners)
    for c in range(3):
        own = by_vertices[3 * pixels + c]
        lit = look.albedo[corners, c, None] * np.einsum(
            "vx,vxp->vp", look.light[:, c] @ slope[corners], turned
        )
        jacobian = [
            moving.through(own) + shown[:, corners] @ lit,
            shown @ (look.albedo[:, c, None] * shape),
            own @ shift,
        ]
        residual = drawn.residual[pixels, c]
        scale = np.where(inner, looks.outlier, looks.rim_outlier)
        weight = (
            settings.colour
            * level.factor**2
            * usable
            / looks.noise**2
            / (1.0 + (residual / scale) ** 2) ** 2
        )
        by_albedo = (
            shown.copy()
        )  # zeros at the rim stay in it: what is shown there follows its neighbours
        by_albedo.data = (
            shown.data * np.repeat(inner, np.diff(shown.indptr)) * values[shown.indices, c]
        )
        rows.append(ViewRows(residual, weight, np.concatenate(jacobian, 1), by_albedo))
    return rows


def rim_pixels(
    frame: Frame, level: ColourLevel, moving: Moving, max_cosine: float
) -> Bool[np.ndarray, " HW"]:
    """Pixels of the model where its surface turns away from the camera (cosine between view and
    normal below ``max_cosine``), or where it ends.
    """
    view = moving.vertices - eye_of(level.camera)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    cosine = -(moving.normals * view).sum(1, keepdims=True)
    return frame.image(torch.from_numpy(cosine), 0.0).numpy().ravel() < max_cosine


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
