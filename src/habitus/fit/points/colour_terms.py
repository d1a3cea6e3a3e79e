"""E_C and E_Q (T eqs 4.4 and 4.7): the person is drawn before the background, lit, and compared
with what was seen.

    "colour"  sum w rho(I - (alpha a h(n) L + (1 - alpha) I_background))
              + sum over edges rho(log a_u - log a_v) / sd^2 + priors of light L and colour camera

Derivatives are the renderer's own, of antialiased images: outlines move, albedo a is carried along,
normals n turn in the light. Albedo, a number for each vertex and channel, is eliminated (Schur
complement of its sparse matrix) and follows a step of the other unknowns (variable projection).
Pixels where the surface turns away say where it ends: they count for more, a large difference is
believed there, and albedo does not follow them, as it would paint the background on the person. At
a level of the pyramid (T 4.6.1) a pixel is the mean of several.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.points.appearance import (
    LIGHT_SD,
    NOISE,
    ORDERS,
    OUTLIER,
    PRIOR_SD,
    Appearance,
    eye_of,
    log_smoothness,
    moved,
    smoothness_cost,
    to_linear,
)
from habitus.fit.points.prepared_views import PreparedView
from habitus.fit.points.settings import RgbdSettings
from habitus.fit.points.skin_offsets import SkinField
from habitus.mesh.normal_jacobian import normal_jacobian
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera
from habitus.observe.harmonics import harmonics, harmonics_slope
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.jacobians.images import image_jacobian
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec
from habitus.solve.terms import Quadratic, Term

MARGIN = 24
"""Full-size pixels around the person that are looked at."""
SATURATED = 254
"""Bytes from which a pixel is overexposed."""


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
        sight: PreparedView,
        vertices: Float[np.ndarray, "V 3"],
        shift: Float[np.ndarray, " 3"],
        factor: int,
    ) -> "ColourLevel | None":
        """The neighbourhood of a surface in a view; None without colour of the person and of the
        empty room.
        """
        if (
            sight.colour_camera is None
            or sight.view.colour is None
            or sight.view.background_colour is None
        ):
            return None
        camera = moved(sight.colour_camera, shift)
        pixels = camera.project(torch.from_numpy(vertices))[0].numpy()
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(pixels.min(0)) - MARGIN, 0, size - factor).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + MARGIN, low + factor, size).astype(int)
        across, down = (high - low) // factor * factor
        part = (slice(low[1], low[1] + down), slice(low[0], low[0] + across))
        small = camera.replace(
            width=int(across) // factor,
            height=int(down) // factor,
            focal_length=camera.focal_length / factor,
            principal_point=(camera.principal_point - torch.from_numpy(low.astype(float))) / factor,
        )
        seen, room = (
            to_linear(image[part]) for image in (sight.view.colour, sight.view.background_colour)
        )
        usable = (sight.view.colour[part].max(-1) < SATURATED)[..., None].astype(float)
        least = _means(usable, factor)[..., 0] > 1.0 - 1e-9
        return ColourLevel(
            small, factor, _means(seen, factor), _means(room, factor), least.astype(float)
        )


def _means(image: Float[np.ndarray, "H W C"], factor: int) -> Float[np.ndarray, "h w C"]:
    height, width = (size // factor for size in image.shape[:2])
    return image.reshape(height, factor, width, factor, -1).mean((1, 3))


RIM_COSINE = 0.15
"""Between view and surface: below it a pixel belongs to the rim."""
RIM_OUTLIER = 0.6
"""Difference of colours that counts a quarter at the rim."""
DARKEST_SHADE = 0.02
LEAST, MOST = 0.003, 3.0
"""Of albedo."""
ALBEDO_DAMPING = 0.01


@dataclass(frozen=True, eq=False)
class Look:
    """What a person looks like: albedo (V, 3), light (9, 3) in the views' world, linear; shift (3,)
    of the colour camera (m).
    """

    albedo: Float[np.ndarray, "V 3"]
    light: Float[np.ndarray, "9 3"]
    shift: Float[np.ndarray, " 3"]

    @staticmethod
    def of(found: Appearance) -> "Look":
        """The look of light and albedo as they were found."""
        return Look(found.albedo.clip(LEAST, MOST), found.light, found.shift.shift)


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
        found = surface_jacobian(body, state.betas, state.pose[k], state.trans[k])
        vertices = np.ascontiguousarray(found.surface.vertices)
        count = body.num_vertices
        by_betas, by_pose = (
            part.reshape(3 * count, -1) for part in (found.vertices_betas, found.vertices_pose)
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
    ) -> "Drawn":
        """In the light and albedo of ``look``."""
        shape = harmonics(torch.from_numpy(normals)).numpy()
        values = look.albedo * (shape @ look.light).clip(DARKEST_SHADE)
        frame = draw(level.camera, torch.from_numpy(vertices), triangles)
        image = frame.image(torch.from_numpy(values), torch.from_numpy(level.room)).numpy()
        return Drawn(frame, shape, values, (image - level.seen).reshape(-1, 3))

    def cost(
        self, level: ColourLevel, rim: Bool[np.ndarray, " HW"], settings: RgbdSettings
    ) -> float:
        """E_C of the view, robust; rim: pixels that count as the model's rim."""
        weight = settings.colour * level.factor**2 / NOISE**2 * level.usable.ravel()
        weight = weight * np.where(rim, settings.rim, 1.0)
        scale = np.where(rim, RIM_OUTLIER, OUTLIER)[:, None]
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
    drawn = drawn or Drawn.of(moving.vertices, moving.normals, triangles, level, look)
    frame, shape, values = drawn.frame, drawn.shape, drawn.values
    slope = harmonics_slope(torch.from_numpy(moving.normals)).numpy()
    points = torch.from_numpy(moving.vertices)
    room = torch.from_numpy(level.room)
    found = image_jacobian(frame, torch.from_numpy(values), room)
    by_vertices = found.to_vertices(level.camera, points)
    shown = found.values.tocsr()
    pixels = np.flatnonzero(np.diff(shown.indptr))
    shown = shown[pixels]
    inner = ~rim_pixels(frame, level, moving)[pixels]
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
        scale = np.where(inner, OUTLIER, RIM_OUTLIER)
        weight = (
            settings.colour
            * level.factor**2
            * usable
            / NOISE**2
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


def rim_pixels(frame: Frame, level: ColourLevel, moving: Moving) -> Bool[np.ndarray, " HW"]:
    """Pixels of the model where its surface turns away from the camera, or where it ends."""
    view = moving.vertices - eye_of(level.camera)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    cosine = -(moving.normals * view).sum(1, keepdims=True)
    return frame.image(torch.from_numpy(cosine), 0.0).numpy().ravel() < RIM_COSINE


@dataclass(frozen=True, eq=False)
class Eliminated:
    """What gives the step of a channel's log albedo back: of the vertices that are shown, by a step
    of ``columns``.
    """

    vertices: Int[np.ndarray, " v"]
    columns: Int[np.ndarray, " c"]
    solved: Float[np.ndarray, "v c1"]


@dataclass(frozen=True, eq=False)
class ColourEquations:
    """E_C + E_Q and the priors of light and shift, albedo eliminated: gradient (n,) and matrix (n,
    n) of betas, trans and pose of each view, skin, light (27, channel after channel) and the colour
    camera's shift (3).
    """

    gradient: Float[np.ndarray, " n"]
    matrix: Float[np.ndarray, "n n"]
    eliminated: tuple[Eliminated, ...]

    def after(self, look: Look, step: Float[np.ndarray, " n"]) -> Look:
        """What the person looks like a step further."""
        log = np.log(look.albedo)
        for c, one in enumerate(self.eliminated):
            change = -one.solved[:, -1] - one.solved[:, :-1] @ step[one.columns]
            log[one.vertices, c] += np.clip(change, -1.0, 1.0)
        albedo = np.exp(np.clip(log, np.log(LEAST), np.log(MOST)))
        light = look.light + step[-30:-3].reshape(3, 9).T
        return Look(albedo, light, look.shift + step[-3:])


def colour_equations(
    views: Sequence[list[ViewRows] | None],
    state: BodyState,
    count: int,
    look: Look,
    edges: sparse.csr_array,
    settings: RgbdSettings,
) -> ColourEquations:
    """The normal equations of all views that have colours (None: it has none)."""
    head = len(state.betas)
    width = 3 + state.pose[0].size
    moving = head + width * len(state.pose)
    size = moving + count + 30
    field = moving + np.arange(count)
    matrix = np.zeros((size, size))
    gradient = np.zeros(size)
    solved = []
    for c in range(3):
        light = size - 30 + 9 * c + np.arange(9)
        tail = np.concatenate([light, size - 3 + np.arange(3)])
        rows = [
            (
                view[c],
                np.concatenate([np.arange(head), head + k * width + np.arange(width), field, tail]),
            )
            for k, view in enumerate(views)
            if view is not None
        ]
        own, slope, found = _channel(
            rows, look.albedo[:, c], edges, np.append(np.arange(size - 30), tail), settings
        )
        certain = settings.colour / np.array(LIGHT_SD)[ORDERS] ** 2
        own[light, light] += certain
        slope[light] += certain * (look.light[:, c] - WHITE)
        matrix = matrix + own
        gradient = gradient + slope
        solved.append(found)
    last = size - 3 + np.arange(3)
    matrix[last, last] += 1.0 / PRIOR_SD**2
    gradient[last] += look.shift / PRIOR_SD**2
    return ColourEquations(gradient, matrix, tuple(solved))


def _channel(
    views: list[tuple[ViewRows, Int[np.ndarray, " n"]]],
    albedo: Float[np.ndarray, " V"],
    edges: sparse.csr_array,
    used: Int[np.ndarray, " c"],
    settings: RgbdSettings,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"], Eliminated]:
    """Matrix and gradient of one channel without its albedo, and what gives the albedo's step
    back.
    """
    size = int(used.max()) + 1
    matrix = np.zeros((size, size))
    gradient = np.zeros(size)
    shown = np.unique(np.concatenate([rows.by_albedo.indices for rows, _ in views]))
    smooth, pull = log_smoothness(edges, albedo)
    inner = settings.colour * smooth[shown][:, shown] + sparse.diags_array(
        np.full(len(shown), ALBEDO_DAMPING)
    )
    right = settings.colour * pull[shown]
    meeting = np.zeros((len(shown), size))
    for rows, columns in views:
        by_albedo = rows.by_albedo[:, shown]
        weighed = rows.jacobian * rows.weight[:, None]
        matrix[np.ix_(columns, columns)] += weighed.T @ rows.jacobian
        gradient[columns] += weighed.T @ rows.residual
        inner = inner + by_albedo.T @ (sparse.diags_array(rows.weight) @ by_albedo)
        meeting[:, columns] += by_albedo.T @ weighed
        right = right + by_albedo.T @ (rows.weight * rows.residual)
    meeting = meeting[:, used]
    solved = splu(inner.tocsc()).solve(np.column_stack([meeting, right]))
    matrix[np.ix_(used, used)] -= meeting.T @ solved[:, :-1]
    gradient[used] -= meeting.T @ solved[:, -1]
    return matrix, gradient, Eliminated(shown, used, solved)


WHITE = np.array([2.0 / np.sqrt(np.pi), *[0.0] * 8])
"""White light from everywhere, which brings a white surface to 1."""


@dataclass(frozen=True, eq=False)
class ColourEnergy:
    """The term "colour" around a state: crops and rims of the views are held, albedo follows the
    other unknowns as the equations there have it.

    values: the state by name: betas, pose, trans, skin, light (3, 9) and shift (3,).
    """

    body: BodyModel
    field: SkinField
    triangles: Triangles
    values: Mapping[str, Any]
    levels: tuple[ColourLevel | None, ...]
    rims: tuple[Any, ...]
    look: Look
    edges: sparse.csr_array
    settings: RgbdSettings
    equations: ColourEquations
    start_cost: float

    @staticmethod
    def of(
        body: BodyModel,
        field: SkinField,
        triangles: Triangles,
        values: Mapping[str, Any],
        views: Sequence[tuple[Moving, ColourLevel] | None],
        look: Look,
        edges: sparse.csr_array,
        settings: RgbdSettings,
    ) -> "ColourEnergy":
        """views: each surface with its motion, and what was seen; None without colours."""
        rows: list[list[ViewRows] | None] = []
        rims: list[Any] = []
        cost = 0.0
        for view in views:
            if view is None:
                rows.append(None)
                rims.append(None)
                continue
            moving, level = view
            drawn = Drawn.of(moving.vertices, moving.normals, triangles, level, look)
            rims.append(rim_pixels(drawn.frame, level, moving))
            rows.append(view_rows(moving, triangles, level, look, settings, drawn))
            cost += drawn.cost(level, rims[-1], settings)
        state = BodyState(values["betas"], values["pose"], values["trans"])
        equations = colour_equations(rows, state, len(values["skin"]), look, edges, settings)
        levels = tuple(None if view is None else view[1] for view in views)
        cost += _prior_cost(look, edges, settings)
        return ColourEnergy(
            body,
            field,
            triangles,
            dict(values),
            levels,
            tuple(rims),
            look,
            edges,
            settings,
            equations,
            cost,
        )

    def term(self) -> Term:
        """Over betas, pose, trans, skin, light and shift."""

        def residual(
            betas: np.ndarray,
            pose: np.ndarray,
            trans: np.ndarray,
            skin: np.ndarray,
            light: np.ndarray,
            shift: np.ndarray,
        ) -> Quadratic:
            values = {
                "betas": betas,
                "pose": pose,
                "trans": trans,
                "skin": skin,
                "light": light,
                "shift": shift,
            }
            return Quadratic(self.cost(values), self._derivatives)

        return Term(residual, name="colour")

    def look_at(self, values: Mapping[str, Any]) -> Look:
        """Albedo, light and shift at a state."""
        return self.equations.after(self.look, _in_order(values) - _in_order(self.values))

    def cost(self, values: Mapping[str, Any]) -> float:
        """At a state, with the albedo that follows."""
        if all(np.array_equal(values[name], self.values[name]) for name in values):
            return self.start_cost
        look = self.look_at(values)
        models = np.asarray(self.body(values["betas"], values["pose"], values["trans"]).vertices)
        seen = self.field.seen(models, values["skin"])
        total = _prior_cost(look, self.edges, self.settings)
        for level, rim, surface in zip(self.levels, self.rims, seen, strict=True):
            if level is None:
                continue
            here = replace(level, camera=moved(level.camera, look.shift - self.look.shift))
            surface = np.ascontiguousarray(surface)
            normals = vertex_normals(surface, self.body.faces)
            drawn = Drawn.of(surface, normals, self.triangles, here, look)
            total += drawn.cost(level, rim, self.settings)
        return total

    def _derivatives(self) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
        """At the state that the equations are of: steps from elsewhere renew them."""
        places = _places(self.values)
        names = list(places)
        gradient, matrix = self.equations.gradient, self.equations.matrix
        blocks = {
            (a, b): matrix[np.ix_(places[a], places[b])]
            for k, a in enumerate(names)
            for b in names[k:]
        }
        return {name: gradient[where] for name, where in places.items()}, blocks


def _places(values: Mapping[str, Any]) -> dict[str, Int[np.ndarray, " n"]]:
    """Where the numbers of each unknown are in `ColourEquations`."""
    head = len(values["betas"])
    count = len(values["pose"])
    width = 3 + values["pose"][0].size
    views = head + np.arange(count * width).reshape(count, width)
    end = head + count * width
    skin = end + np.arange(len(values["skin"]))
    light = end + len(skin) + np.arange(27)
    return {
        "betas": np.arange(head),
        "trans": views[:, :3].ravel(),
        "pose": views[:, 3:].ravel(),
        "skin": skin,
        "light": light,
        "shift": light[-1] + 1 + np.arange(3),
    }


def _in_order(values: Mapping[str, Any]) -> Float[np.ndarray, " n"]:
    places = _places(values)
    out = np.empty(sum(map(len, places.values())))
    for name, where in places.items():
        out[where] = np.ravel(values[name])
    return out


def _prior_cost(look: Look, edges: sparse.csr_array, settings: RgbdSettings) -> float:
    """E_Q, and the priors of light and colour camera."""
    certain = settings.colour / np.array(LIGHT_SD)[ORDERS] ** 2
    light = 0.5 * float((certain @ (look.light - WHITE[:, None]) ** 2).sum())
    smooth = sum(smoothness_cost(edges, look.albedo[:, c]) for c in range(3))
    return light + settings.colour * smooth + 0.5 * float(look.shift @ look.shift) / PRIOR_SD**2
