"""The whole energy of one body before its views (T eq. 4.3), and steps down it.

    E = E_C + E_D + E_F + E_P + E_S + E_Q

`Energy.geometry` names what depth says: "depth" (E_D), "outline" (pixels of the model where the
room was seen) and "floor" (E_F), new at each step, as which pixel belongs to which point changes.
`Priors` are E_P and E_S; E_C and E_Q, which know albedo and light, join for the last steps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import sparse

from habitus.body.model import BodyModel
from habitus.fit.rgbd.appearance import edges_of
from habitus.fit.rgbd.colour_levels import ColourLevel
from habitus.fit.rgbd.colour_terms import ColourEquations, Look, Moving, colour_equations, view_rows
from habitus.fit.rgbd.energy import (
    NOTHING,
    Priors,
    State,
    costs_of,
    data_equations,
    gauss_newton_step,
)
from habitus.fit.rgbd.feet import Footpads
from habitus.fit.rgbd.matching import look, match
from habitus.fit.rgbd.off_model import OffModel, off_equations, uncoated
from habitus.fit.rgbd.settings import RgbdSettings, Stage
from habitus.fit.rgbd.sights import Grid, Sight
from habitus.render.triangles import Triangles
from habitus.residuals.surface_points import PointMatches, SurfacePointSolver

TINY = 1e-6


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
    solver: SurfacePointSolver
    triangles: Triangles
    pads: Footpads | None

    @staticmethod
    def of(body: BodyModel, sights: Sequence[Sight], settings: RgbdSettings) -> "Energy":
        """The energy of a body before some views."""
        triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
        return Energy(
            body, tuple(sights), settings, SurfacePointSolver.of(body), triangles, Footpads.of(body)
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
    ) -> list[Mapping[str, PointMatches]]:
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
            step = -np.linalg.solve(whole + TINY * np.eye(len(slope)), slope)
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
            weights + TINY * (1.0 + matrix.diagonal())
        )
        depth.gradient[:size] += gradient + weights * priors.apart(state)
        cost += depth.cost + sum(priors.costs(state).values())
        return cost, depth.gradient, depth.matrix + TINY * np.eye(len(depth.gradient))

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

    def _floor(self, sight: Sight, surface: Float[np.ndarray, "V 3"], stage: Stage) -> PointMatches:
        if self.pads is None or not sight.on_floor or stage.moves != "all":
            return NOTHING
        return self.pads.on_floor(
            self.settings.floor / self.settings.floor_sd**2, surface, self.body
        )
