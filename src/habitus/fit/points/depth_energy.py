"""The energy of a body before depth views (thesis eq. 4.3), as named terms, and its minimisation.

    E = E_C + E_D + E_F + E_P + E_S + E_Q

    "depth"    E_D, robust (thesis eq. 4.5): pixels against the surface (`depth_correspondences`),
               with skin offsets in the last stages (`skin_offsets`)
    "outline"  points of the model before background that was seen, against the silhouette (ours)
    "floor"    E_F (thesis eq. 4.6): soles on the floor (`Footpads`), once a stage
               moves all unknowns
    "shape"    E_S, "pose" E_P (thesis sec. 4.6.1): Gaussians (`priors`)
    "skin"     1/2 |z|^2, the prior of the skin offsets (ours)
    "colour"   E_C + E_Q (thesis eqs. 4.4 and 4.7) with the priors of light and colour camera
               (`colour_terms`)

The weights are in the table of `habitus.fit.points`: fields of `depth_settings.RgbdSettings`,
those of light, albedo and camera shift of `AppearanceSettings`. Correspondences are renewed
before each step (`habitus.solve.alternate`); a step that raises the cost at its correspondences is
refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.points.appearance import edges_of
from habitus.fit.points.colour_terms import ColourEnergy
from habitus.fit.points.colour_views import ColourLevel, Look, Moving
from habitus.fit.points.correspondences import Footpads
from habitus.fit.points.depth_correspondences import look, match
from habitus.fit.points.depth_settings import STIFF, DepthStage, RgbdSettings
from habitus.fit.points.prepared_views import Grid, PreparedView
from habitus.fit.points.skin_offsets import (
    SkinField,
    SkinPlanes,
    moved_back,
    skin_planes_term,
    skin_prior,
)
from habitus.fit.points.terms import points_around, pose_prior, shape_prior
from habitus.render.triangles import Triangles
from habitus.residuals.points import PointObservations, PointSolver
from habitus.solve.alternate import Stage, alternate
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import Minimized
from habitus.solve.terms import Term

BLOCKS = ("trans", "pose")
"""Unknowns of single views, which meet only in shape and skin."""


@dataclass(frozen=True, eq=False)
class SkinnedState:
    """A state of K views, and the numbers z (C,) of the skin offsets."""

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "K J 3"]
    trans: Float[np.ndarray, "K 3"]
    skin: Float[np.ndarray, " C"]

    @property
    def body(self) -> BodyState:
        """Without the skin."""
        return BodyState(self.betas, self.pose, self.trans)


@dataclass(frozen=True, eq=False)
class DepthEnergy:
    """A body, what was seen, and the weights; `DepthEnergy.of` lays it out once."""

    body: BodyModel
    views: tuple[PreparedView, ...]
    settings: RgbdSettings
    solver: PointSolver
    triangles: Triangles
    pads: Footpads | None

    @staticmethod
    def of(body: BodyModel, views: Sequence[PreparedView], settings: RgbdSettings) -> "DepthEnergy":
        """The energy of a body before some views."""
        triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
        return DepthEnergy(
            body, tuple(views), settings, PointSolver.of(body), triangles, Footpads.of(body)
        )

    def surfaces(self, state: BodyState | SkinnedState) -> Float[np.ndarray, "K V 3"]:
        """The surfaces of all views, each in its world (m), without skin offsets."""
        return np.asarray(self.body(state.betas, state.pose, state.trans).vertices)

    def grids(self, stride: int) -> list[Grid]:
        """Every stride-th pixel of each view."""
        return [view.grid(stride) for view in self.views]

    def minimized(
        self, state: BodyState, means: Float[np.ndarray, "K J 3"], stages: Sequence[DepthStage]
    ) -> Minimized:
        """The state after some stages by depth alone, without skin offsets.

        means: of the pose prior.
        """
        priors = self.priors(means)
        grids = {stage.stride: self.grids(stage.stride) for stage in stages}

        def terms_at(values: dict[str, Any], stage: DepthStage, step: int) -> dict[str, Term]:
            scale = float(np.linspace(*stage.scales, stage.steps)[step])
            now = BodyState(**values)
            observations = self.observations(self.surfaces(now), grids[stage.stride], stage, scale)
            return {**self.points_terms(now, observations), **priors}

        return alternate(
            terms_at,
            state,
            [freed(stage, self.body, self.settings) for stage in stages],
            steps=Levenberg(self.settings.damping),
            blocks=BLOCKS,
        )

    def with_skin(
        self, state: SkinnedState, means: Float[np.ndarray, "K J 3"], field: SkinField
    ) -> Minimized:
        """State and skin offsets after some steps by depth alone."""

        def terms_at(values: dict[str, Any], stage: Stage, step: int) -> dict[str, Term]:
            return self._skin_terms(SkinnedState(**values), means, field)

        return alternate(
            terms_at,
            state,
            [Stage(self.settings.skin_steps, max_step=self.settings.max_step)],
            steps=Levenberg(self.settings.damping),
            blocks=BLOCKS,
        )

    def with_colour(
        self,
        state: SkinnedState,
        look: Look,
        means: Float[np.ndarray, "K J 3"],
        field: SkinField,
    ) -> tuple[Minimized, SkinnedState, Look]:
        """State, skin offsets, light, albedo and colour camera after steps on the whole energy,
        coarse to fine in the colours.
        """
        edges = edges_of(self.body.faces)
        looks = self.settings.appearance
        levels = self.settings.colour_levels
        names = ("betas", "pose", "trans", "skin")
        last: ColourEnergy | None = None

        def terms_at(values: dict[str, Any], stage: Stage, step: int) -> dict[str, Term]:
            nonlocal last
            now = SkinnedState(**{name: values[name] for name in names})
            seen = look if last is None else last.look_at(values)
            views = []
            for k, view in enumerate(self.views):
                moving = Moving.of(self.body, now.body, k, field, now.skin)
                level = ColourLevel.of(view, moving.vertices, seen.shift, levels[step], looks)
                views.append(None if level is None else (moving, level))
            last = ColourEnergy.of(
                self.body, field, self.triangles, values, views, seen, edges, self.settings
            )
            return {**self._skin_terms(now, means, field), "colour": last.term()}

        start = {
            **vars(state),
            "light": np.ascontiguousarray(look.light.T),
            "shift": look.shift,
        }
        solved = alternate(
            terms_at,
            start,
            [Stage(len(levels), max_step=self.settings.max_step)],
            steps=Levenberg(self.settings.damping),
        )
        assert last is not None
        ended = SkinnedState(**{name: solved.state[name] for name in names})
        return solved, ended, last.look_at(solved.state)

    def priors(self, means: Float[np.ndarray, "K J 3"]) -> dict[str, Term]:
        """E_S about people's mean, and E_P about a pose for each view; the root is free."""
        body = self.body
        settings = self.settings
        stiff = [any(part in name for part in STIFF) for name in body.joint_names]
        sd = np.where(stiff, settings.stiff_sd, settings.pose_sd)
        precision = settings.pose / np.repeat(sd, 3) ** 2
        precision[:3] = 0.0
        mean = np.zeros(body.num_betas) if body.people_mean is None else body.people_mean
        return {
            "shape": shape_prior(mean, settings.shape),
            "pose": pose_prior(means.reshape(len(means), -1), np.diag(precision)),
        }

    def observations(
        self,
        seen: Float[np.ndarray, "K V 3"],
        grids: Sequence[Grid],
        stage: DepthStage,
        scale: float,
    ) -> list[dict[str, PointObservations]]:
        """Of each view the correspondences of its pixels on surfaces, by the term's name."""
        observations = []
        for view, grid, surface in zip(self.views, grids, seen, strict=True):
            noise = self.settings.noise if view.noise is None else view.noise
            drawn = look(grid, surface, self.triangles)
            here = dict(match(grid, drawn, stage, scale, noise, self.settings).matches)
            if self.pads is not None and view.on_floor and stage.moves == "all":
                here["floor"] = self.pads.on_floor(surface, self.body, self.settings)
            observations.append(here)
        return observations

    def points_terms(
        self, state: BodyState, views: Sequence[Mapping[str, PointObservations]]
    ) -> dict[str, Term]:
        """The terms of correspondences around a state, without those that have none."""
        terms = {}
        for name in ("depth", "outline", "floor"):
            frames = [view.get(name) for view in views]
            frames = [None if one is None or not len(one.face) else one for one in frames]
            if any(one is not None for one in frames):
                terms[name] = points_around(self.solver, state, frames)
        return terms

    def _skin_terms(
        self, state: SkinnedState, means: Float[np.ndarray, "K J 3"], field: SkinField
    ) -> dict[str, Term]:
        """All terms but colour, correspondences being those of surfaces with skin and clothes."""
        settings = replace(self.settings, depth=self.settings.skin_depth)
        stage = replace(self.settings.stages[-1], stride=2)
        models = self.surfaces(state)
        seen = field.seen(models, state.skin)
        energy = replace(self, settings=settings)
        observations = energy.observations(seen, self.grids(stage.stride), stage, stage.scales[-1])
        depth = [
            SkinPlanes.of(field, state.body, k, state.skin, view["depth"], models[k], seen[k])
            for k, view in enumerate(observations)
        ]
        rest = [
            {
                **{name: points for name, points in view.items() if name != "depth"},
                "outline": moved_back(view["outline"], models[k], seen[k], self.body),
            }
            for k, view in enumerate(observations)
        ]
        count = len(state.skin)
        return {
            "depth": skin_planes_term(self.body, depth, count),
            **self.points_terms(state.body, rest),
            **self.priors(means),
            "skin": skin_prior(count),
        }


def freed(stage: DepthStage, body: BodyModel, settings: RgbdSettings) -> DepthStage:
    """The stage with what it moves: translation and root ("place"), pose ("pose"), all."""
    fixed = () if stage.moves == "all" else ("betas",)
    masks = {}
    if stage.moves == "place":
        masks["pose"] = (np.arange(body.num_joints) < 1)[:, None]
    return replace(stage, fixed=fixed, masks=masks, max_step=settings.max_step)
