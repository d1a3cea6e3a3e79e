"""The energy of T eq. 4.3 without colour, as named terms over one shape and a pose and place for
each view.

Each term gives a cost, a gradient and a Gauss-Newton matrix over betas (B), then trans (3) and pose
(3 J) of each view.

The whole energy of one body before its views (T eq. 4.3), and steps down it.

    E = E_C + E_D + E_F + E_P + E_S + E_Q

`Energy.geometry` names what depth says: "depth" (E_D), "outline" (pixels of the model where the
room was seen) and "floor" (E_F), new at each step, as which pixel belongs to which point changes.
`Priors` are E_P and E_S; E_C and E_Q, which know albedo and light, join for the last steps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse

from habitus.body.model import BodyModel
from habitus.fit.points.appearance import edges_of
from habitus.fit.points.colour_terms import (
    ColourEquations,
    ColourLevel,
    Look,
    Moving,
    colour_equations,
    view_rows,
)
from habitus.fit.points.depth_correspondences import look, match
from habitus.fit.points.floor import Footpads
from habitus.fit.points.prepared_views import Grid, Sight
from habitus.fit.points.settings import STIFF, RgbdSettings, Stage
from habitus.fit.points.skin_offsets import OffModel, off_equations, uncoated
from habitus.fit.points.state import State
from habitus.render.triangles import Triangles
from habitus.residuals.points import PointObservations, PointSolver
from habitus.solve.arrow import ArrowMatrix


@dataclass(frozen=True, eq=False)
class Priors:
    """E_S and E_P: Gaussians over betas and over each view's pose (T 4.6.1)."""

    betas_mean: Float[np.ndarray, " B"]
    pose_mean: Float[np.ndarray, "K J 3"]
    pose_sd: Float[np.ndarray, " J"]
    settings: RgbdSettings

    @staticmethod
    def of(body: BodyModel, start: State, settings: RgbdSettings) -> "Priors":
        """Those around a start."""
        stiff = [any(part in name for part in STIFF) for name in body.joint_names]
        sd = np.where(stiff, settings.stiff_sd, settings.pose_sd)
        mean = np.zeros(body.num_betas) if body.people_mean is None else body.people_mean
        return Priors(mean, start.pose, sd, settings)

    def weights(self) -> Float[np.ndarray, " n"]:
        """The matrix, which is diagonal; the root is free."""
        joints = self.settings.pose / np.repeat(self.pose_sd, 3) ** 2
        joints[:3] = 0.0
        view = np.concatenate([np.zeros(3), joints])
        return np.concatenate(
            [np.full(len(self.betas_mean), self.settings.shape), np.tile(view, len(self.pose_mean))]
        )

    def apart(self, state: State) -> Float[np.ndarray, " n"]:
        """The state less the means."""
        return (
            state.vector - State(self.betas_mean, self.pose_mean, np.zeros_like(state.trans)).vector
        )

    def costs(self, state: State) -> dict[str, float]:
        """E_S and E_P."""
        each = 0.5 * self.weights() * self.apart(state) ** 2
        count = len(self.betas_mean)
        return {"shape": float(each[:count].sum()), "pose": float(each[count:].sum())}


def merged(terms: Mapping[str, PointObservations]) -> PointObservations:
    """Terms of one view as one, with as many directions a point as the most of them."""
    given = [one for one in terms.values() if len(one.face)]
    if not given:
        return NOTHING
    most = max(one.directions.shape[1] for one in given)
    padded = [
        replace(
            one,
            directions=np.pad(
                one.directions, ((0, 0), (0, most - one.directions.shape[1]), (0, 0))
            ),
        )
        for one in given
    ]
    return PointObservations(
        *(np.concatenate([getattr(one, name) for one in padded]) for name in _FIELDS)
    )


NOTHING = PointObservations(
    np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 1, 3))
)
"""No points at all."""
_FIELDS = ("face", "barycentric", "target", "directions")


def gauss_newton_step(
    solver: PointSolver,
    state: State,
    terms: list[Mapping[str, PointObservations]],
    priors: Priors,
    moves: str,
) -> tuple[State, float]:
    """One step of all that ``moves`` ("place", "pose", "all"); the state it leads to, and the cost
    before it.
    """
    cost, gradient, matrix = data_equations(solver, state, terms)
    weights = priors.weights()
    gradient = gradient + weights * priors.apart(state)
    free = _free(state, moves)
    damping = np.where(free, weights + 1e-6 * (1.0 + matrix.diagonal()), 0.0)
    matrix = _restricted(matrix, free)
    step = matrix.solve(damping + ~free, np.where(free, -gradient, 0.0))
    return state.moved(step), cost + sum(priors.costs(state).values())


def data_equations(
    solver: PointSolver, state: State, terms: list[Mapping[str, PointObservations]]
) -> tuple[float, np.ndarray, ArrowMatrix]:
    """Each term apart, as one with few directions need not pay for one with many."""
    found = [
        solver.together(
            state.betas, state.pose, state.trans, [merged({name: one[name]}) for one in terms]
        )
        for name in terms[0]
        if any(len(one[name].face) for one in terms)
    ]
    cost, gradient, matrix = found[0]
    for more, slope, other in found[1:]:
        cost = cost + more
        gradient = gradient + slope
        matrix = ArrowMatrix(
            matrix.shared + other.shared, matrix.border + other.border, matrix.blocks + other.blocks
        )
    return cost, gradient, matrix


def costs_of(
    solver: PointSolver, state: State, terms: list[Mapping[str, PointObservations]]
) -> dict[str, float]:
    """The cost of each term, all views together."""
    return {
        name: solver.together(
            state.betas, state.pose, state.trans, [merged({name: one[name]}) for one in terms]
        )[0]
        for name in terms[0]
    }


def _free(state: State, moves: str) -> Bool[np.ndarray, " n"]:
    views = len(state.pose)
    width = 3 + state.pose[0].size
    own = np.arange(width) < (6 if moves == "place" else width)
    return np.concatenate([np.full(len(state.betas), moves == "all"), np.tile(own, views)])


def _restricted(matrix: ArrowMatrix, free: Bool[np.ndarray, " n"]) -> ArrowMatrix:
    """The matrix without the rows and columns of what does not move."""
    head = free[: len(matrix.shared)].astype(float)
    tail = free[len(matrix.shared) :].reshape(matrix.blocks.shape[:2]).astype(float)
    return ArrowMatrix(
        matrix.shared * head[:, None] * head,
        matrix.border * tail[:, :, None] * head,
        matrix.blocks * tail[:, :, None] * tail[:, None, :],
    )


DAMPING = 1e-6


@dataclass(frozen=True, eq=False)
class Coated:
    """A state, and the numbers (C,) of the skin off its model."""

    state: State
    numbers: Float[np.ndarray, " C"]

    def moved(self, step: Float[np.ndarray, " m"]) -> "Coated":
        """Both a step further."""
        size = len(step) - len(self.numbers)
        return Coated(self.state.moved(step[:size]), self.numbers + step[size:])


@dataclass(frozen=True, eq=False)
class Energy:
    """A body, what was seen, and the weights; `Energy.of` lays it out once."""

    body: BodyModel
    sights: tuple[Sight, ...]
    settings: RgbdSettings
    solver: PointSolver
    triangles: Triangles
    pads: Footpads | None

    @staticmethod
    def of(body: BodyModel, sights: Sequence[Sight], settings: RgbdSettings) -> "Energy":
        """The energy of a body before some views."""
        triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
        return Energy(
            body, tuple(sights), settings, PointSolver.of(body), triangles, Footpads.of(body)
        )

    def surfaces(self, state: State) -> Float[np.ndarray, "K V 3"]:
        """The surfaces of all views, each in its world (m)."""
        return self.body(state.betas, state.pose, state.trans).vertices

    def priors(self, state: State, means: Float[np.ndarray, "K J 3"]) -> Priors:
        """E_P and E_S, poses being around ``means``."""
        return Priors.of(self.body, replace(state, pose=means), self.settings)

    def grids(self, stride: int) -> list[Grid]:
        """Every stride-th pixel of each view."""
        return [sight.grid(stride) for sight in self.sights]

    def geometry(
        self,
        state: State,
        grids: Sequence[Grid],
        stage: Stage,
        reach: float,
        seen: Float[np.ndarray, "K V 3"] | None = None,
    ) -> list[Mapping[str, PointObservations]]:
        """What depth says of each view at a state, by name. seen: the surfaces, where they are off
        the model.
        """
        terms = []
        settings = self.settings
        for sight, grid, surface in zip(
            self.sights, grids, self.surfaces(state) if seen is None else seen, strict=True
        ):
            noise = settings.noise if sight.noise is None else sight.noise
            found = match(grid, look(grid, surface, self.triangles), stage, reach, noise, settings)
            terms.append({**found.matches, "floor": self._floor(sight, surface, stage)})
        return terms

    def descend(
        self, state: State, means: Float[np.ndarray, "K J 3"], stages: Sequence[Stage]
    ) -> tuple[State, list[float]]:
        """The state after some stages without colour, and the cost before each step."""
        priors = self.priors(state, means)
        costs = []
        for stage in stages:
            grids = self.grids(stage.stride)
            for reach in np.linspace(*stage.reach, stage.steps):
                terms = self.geometry(state, grids, stage, reach)
                state, cost = gauss_newton_step(self.solver, state, terms, priors, stage.moves)
                costs.append(cost)
        return state, costs

    def settle(
        self, coated: "Coated", means: Float[np.ndarray, "K J 3"], off: OffModel
    ) -> tuple["Coated", list[float]]:
        """The state and the skin off the model after some steps by depth alone."""
        costs = []
        for _ in range(self.settings.skin_steps):
            cost, gradient, matrix = self._off(coated, means, off)
            costs.append(cost)
            coated = coated.moved(-np.linalg.solve(matrix, gradient))
        return coated, costs

    def with_colour(
        self, coated: "Coated", shown: Look, means: Float[np.ndarray, "K J 3"], off: OffModel
    ) -> tuple["Coated", Look, list[float], float]:
        """The state and what the person looks like after steps on the whole energy, coarse to fine
        in the colours; the cost before each, and that of colour before the last.
        """
        edges = edges_of(self.body.faces)
        costs = []
        size = len(coated.state.vector) + off.count
        for factor in self.settings.colour_levels:
            colour = self._colour(coated, shown, edges, factor, off)
            cost, gradient, matrix = self._off(coated, means, off)
            whole = colour.matrix.copy()
            slope = colour.gradient.copy()
            whole[:size, :size] += matrix
            slope[:size] += gradient
            costs.append(colour.cost + cost)
            step = -np.linalg.solve(whole + DAMPING * np.eye(len(slope)), slope)
            coated = coated.moved(step[:size])
            shown = colour.after(shown, step)
        return coated, shown, costs, colour.cost

    def _off(
        self, coated: "Coated", means: Float[np.ndarray, "K J 3"], off: OffModel
    ) -> tuple[float, Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
        """Cost, gradient and matrix of all but colour, over the state and the skin off the
        model.
        """
        stage = self.settings.stages[-1]
        state = coated.state
        priors = self.priors(coated.state, means)
        stage = replace(stage, stride=2)
        settings = replace(self.settings, depth=self.settings.skin_depth)
        model = self.surfaces(state)
        seen = off.seen(model, coated.numbers)
        terms = replace(self, settings=settings).geometry(
            state, self.grids(stage.stride), stage, stage.reach[-1], seen
        )
        depth = off_equations(
            off, state, coated.numbers, [one["depth"] for one in terms], model, seen
        )
        rest = [
            {
                **uncoated({"outline": one["outline"]}, model[k], seen[k], self.body),
                "floor": one["floor"],
            }
            for k, one in enumerate(terms)
        ]
        cost, gradient, matrix = data_equations(self.solver, state, rest)
        weights = priors.weights()
        size = len(gradient)
        depth.matrix[:size, :size] += matrix.dense() + np.diag(
            weights + DAMPING * (1.0 + matrix.diagonal())
        )
        depth.gradient[:size] += gradient + weights * priors.apart(state)
        cost += depth.cost + sum(priors.costs(state).values())
        return cost, depth.gradient, depth.matrix + DAMPING * np.eye(len(depth.gradient))

    def costs(self, state: State, means: Float[np.ndarray, "K J 3"]) -> dict[str, float]:
        """The cost of each term but colour at a state, by name."""
        stage = self.settings.stages[-1]
        terms = self.geometry(state, self.grids(stage.stride), stage, stage.reach[-1])
        return {**costs_of(self.solver, state, terms), **self.priors(state, means).costs(state)}

    def _colour(
        self, coated: "Coated", shown: Look, edges: sparse.csr_array, factor: int, off: OffModel
    ) -> ColourEquations:
        views = []
        state = coated.state
        for k, sight in enumerate(self.sights):
            moving = Moving.of(self.body, state, k, off, coated.numbers)
            level = ColourLevel.of(sight, moving.vertices, shown.shift, factor)
            views.append(
                None
                if level is None
                else view_rows(moving, self.triangles, level, shown, self.settings)
            )
        return colour_equations(views, state, off.count, shown, edges, self.settings)

    def _floor(
        self, sight: Sight, surface: Float[np.ndarray, "V 3"], stage: Stage
    ) -> PointObservations:
        if self.pads is None or not sight.on_floor or stage.moves != "all":
            return NOTHING
        return self.pads.on_floor(
            self.settings.floor / self.settings.floor_sd**2, surface, self.body
        )
