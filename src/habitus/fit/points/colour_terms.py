"""E_C and E_Q (T eqs 4.4 and 4.7): colours of the person before the background, as one term.

    "colour"  sum w rho(I - (alpha a h(n) L + (1 - alpha) I_background))
              + sum over edges rho(log a_u - log a_v) / sd^2 + priors of light L and colour camera

Residuals and derivatives of the views are those of `colour_views`. Albedo a, a number for each
vertex and channel, is eliminated (Schur complement of its sparse matrix) and follows a step of the
other unknowns (variable projection).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.offsets import factored, inverse_product
from habitus.fit.points.appearance import (
    ORDERS,
    log_smoothness,
    moved,
    smoothness_cost,
)
from habitus.fit.points.colour_views import (
    ColourLevel,
    Drawn,
    Look,
    Moving,
    ViewRows,
    rim_pixels,
    view_rows,
)
from habitus.fit.points.depth_settings import AppearanceSettings, RgbdSettings
from habitus.fit.points.skin_offsets import SkinField
from habitus.mesh.normals import vertex_normals
from habitus.parallel.workers import map_on_threads
from habitus.render.triangles import Triangles
from habitus.solve.terms import Quadratic, Term


@dataclass(frozen=True, eq=False)
class Eliminated:
    """A channel's log albedo at the vertices that are shown, eliminated from the equations: the
    factor of its own matrix, the matrix shared with the unknowns in ``columns``, its gradient.
    """

    vertices: Int[np.ndarray, " v"]
    columns: Int[np.ndarray, " c"]
    factor: SuperLU
    meeting: Float[np.ndarray, "v c"]
    right: Float[np.ndarray, " v"]

    def change(self, step: Float[np.ndarray, " n"]) -> Float[np.ndarray, " v"]:
        """Change of the log albedo that follows a step of all other unknowns."""
        return -self.factor.solve(self.right + self.meeting @ step[self.columns])


@dataclass(frozen=True, eq=False)
class ColourEquations:
    """E_C + E_Q and the priors of light and shift, albedo eliminated: gradient (n,) and matrix (n,
    n) of betas, trans and pose of each view, skin, light (27, channel after channel) and the colour
    camera's shift (3).
    """

    gradient: Float[np.ndarray, " n"]
    matrix: Float[np.ndarray, "n n"]
    eliminated: tuple[Eliminated, ...]
    settings: AppearanceSettings

    def after(self, look: Look, step: Float[np.ndarray, " n"]) -> Look:
        """What the person looks like a step further."""
        log = np.log(look.albedo)
        for c, channel in enumerate(self.eliminated):
            log[channel.vertices, c] += np.clip(channel.change(step), -1.0, 1.0)
        albedo = np.exp(log).clip(self.settings.min_albedo, self.settings.max_albedo)
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
    looks = settings.appearance
    head = len(state.betas)
    width = 3 + state.pose[0].size
    moving = head + width * len(state.pose)
    size = moving + count + 30
    field = moving + np.arange(count)
    matrix = np.zeros((size, size))
    gradient = np.zeros(size)
    solved = []

    def channel(c: int) -> tuple[np.ndarray, np.ndarray, Eliminated]:
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
        own, slope, eliminated = _channel(
            rows, look.albedo[:, c], edges, np.append(np.arange(size - 30), tail), settings
        )
        certain = settings.colour / np.array(looks.light_sd)[ORDERS] ** 2
        own[light, light] += certain
        slope[light] += certain * (look.light[:, c] - WHITE)
        return own, slope, eliminated

    for own, slope, eliminated in map_on_threads(channel, range(3)):
        matrix = matrix + own
        gradient = gradient + slope
        solved.append(eliminated)
    last = size - 3 + np.arange(3)
    matrix[last, last] += 1.0 / looks.camera_shift_sd**2
    gradient[last] += look.shift / looks.camera_shift_sd**2
    return ColourEquations(gradient, matrix, tuple(solved), looks)


def _channel(
    views: list[tuple[ViewRows, Int[np.ndarray, " _"]]],
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
    smooth, pull = log_smoothness(edges, albedo, settings.appearance)
    inner = settings.colour * smooth[shown][:, shown] + sparse.diags_array(
        np.full(len(shown), settings.appearance.albedo_damping)
    )
    right = settings.colour * pull[shown]
    meeting = np.zeros((len(shown), size))
    for rows, columns in views:
        by_albedo = rows.by_albedo[:, shown]
        root = np.sqrt(rows.weight)
        weighed = rows.jacobian * root[:, None]
        residual = rows.residual * root
        by_albedo = sparse.diags_array(root) @ by_albedo
        matrix[np.ix_(columns, columns)] += weighed.T @ weighed
        gradient[columns] += weighed.T @ residual
        inner = inner + by_albedo.T @ by_albedo
        meeting[:, columns] += by_albedo.T @ weighed
        right = right + by_albedo.T @ residual
    meeting = meeting[:, used]
    factor = factored(inner.tocsc())
    product = inverse_product(factor, np.column_stack([meeting, right]))
    matrix[np.ix_(used, used)] -= product[:-1, :-1]
    gradient[used] -= product[:-1, -1]
    return matrix, gradient, Eliminated(shown, used, factor, meeting, right)


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

        def of_view(
            view: tuple[Moving, ColourLevel] | None,
        ) -> tuple[list[ViewRows] | None, Any, float]:
            if view is None:
                return None, None, 0.0
            moving, level = view
            drawn = Drawn.of(
                moving.vertices, moving.normals, triangles, level, look, settings.appearance
            )
            rim = rim_pixels(drawn.frame, level, moving, settings.appearance.rim_cosine)
            rows = view_rows(moving, triangles, level, look, settings, drawn)
            return rows, rim, drawn.cost(level, rim, settings)

        rows, rims, costs = zip(*map_on_threads(of_view, views), strict=True)
        state = BodyState(values["betas"], values["pose"], values["trans"])
        equations = colour_equations(rows, state, len(values["skin"]), look, edges, settings)
        levels = tuple(None if view is None else view[1] for view in views)
        cost = sum(costs) + _prior_cost(look, edges, settings)
        return ColourEnergy(
            body,
            field,
            triangles,
            dict(values),
            levels,
            rims,
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
            drawn = Drawn.of(surface, normals, self.triangles, here, look, self.settings.appearance)
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


def _places(values: Mapping[str, Any]) -> dict[str, Int[np.ndarray, " _"]]:
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
    looks = settings.appearance
    certain = settings.colour / np.array(looks.light_sd)[ORDERS] ** 2
    light = 0.5 * float((certain @ (look.light - WHITE[:, None]) ** 2).sum())
    smooth = sum(smoothness_cost(edges, look.albedo[:, c], looks) for c in range(3))
    shift = 0.5 * float(look.shift @ look.shift) / looks.camera_shift_sd**2
    return light + settings.colour * smooth + shift
