"""A person drawn before the background, lit, and compared with what a view saw: residuals of E_C
(T eq. 4.4) and their derivatives.

    I - (alpha a h(n) L + (1 - alpha) I_background)

Derivatives are the renderer's own, of antialiased images: outlines move, albedo a is carried along,
normals n turn in the light L. Pixels where the surface turns away say where it ends: they count for
more, a large difference is believed there, and albedo does not follow them, as it would paint the
background on the person. At a level of the pyramid (T 4.6.1) a pixel is the mean of several.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.points.appearance import (
    Appearance,
    eye_of,
    moved,
    to_linear,
)
from habitus.fit.points.depth_settings import APPEARANCE, AppearanceSettings, RgbdSettings
from habitus.fit.points.prepared_views import PreparedView
from habitus.fit.points.skin_offsets import SkinField
from habitus.mesh.normals import normal_jacobian, vertex_normals
from habitus.observe.camera import Camera
from habitus.observe.light import harmonics, harmonics_slope
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.jacobians.images import image_jacobian
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
    """A posed surface and how its vertices move with betas, trans, pose and skin offsets
    (3 V, P); turning (3 V, 3 V): its normals with its vertices.
    """

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    motion: Float[np.ndarray, "V3 P"]
    turning: sparse.csr_array

    @staticmethod
    def of(
        body: BodyModel, state: BodyState, k: int, field: SkinField, skin: Float[np.ndarray, " C"]
    ) -> "Moving":
        """That of view k; the numbers of the skin offsets (C,) are the last of the P."""
        appearance = surface_jacobian(body, state.betas, state.pose[k], state.trans[k])
        vertices = np.ascontiguousarray(appearance.surface.vertices)
        count = body.num_vertices
        by_betas, by_pose = (
            part.reshape(3 * count, -1)
            for part in (appearance.vertices_betas, appearance.vertices_pose)
        )
        normals = vertex_normals(vertices, body.faces)
        vertices = field.seen(vertices, skin)
        by_skin = (normals[..., None] * field.basis[:, None]).reshape(3 * count, -1)
        motion = np.concatenate([by_betas, np.tile(np.eye(3), (count, 1)), by_pose, by_skin], 1)
        turning = normal_jacobian(vertices, body.faces).tocsr()
        return Moving(vertices, vertex_normals(vertices, body.faces), motion, turning)

    def turned(self, some: Int[np.ndarray, " U"]) -> Float[np.ndarray, "U 3 P"]:
        """How the normals of some vertices move."""
        rows = (3 * some[:, None] + np.arange(3)).ravel()
        return (self.turning[rows] @ self.motion).reshape(len(some), 3, -1)


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
            own @ moving.motion + shown[:, corners] @ lit,
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
