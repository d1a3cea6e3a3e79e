"""The energy of a body before depth views (thesis eq. 4.3), as named terms, and its minimisation.

    E = E_C + E_D + E_F + E_P + E_S + E_Q

    "depth"    E_D, robust (thesis eq. 4.5): pixels against the surface (`match`),
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
before each step (`habitus.solve.minimize`); a step that raises the cost at its correspondences is
refused. Those of "depth" are the points of the model's surface that pixels belong to (the nearest
that the camera would see, or the same pixel's); those of "outline" the silhouette's nearest pixel
of what covers the background.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from habitus.body.anatomical_angles import world_rotations
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.points.appearance import edges_of
from habitus.fit.points.clothes import hair_thickness
from habitus.fit.points.colour_terms import ColourEnergy
from habitus.fit.points.colour_views import ColourLevel, Look, Moving
from habitus.fit.points.correspondences import Footpads, points_around, pose_prior, shape_prior
from habitus.fit.points.depth_settings import STANDARD, STIFF, DepthStage, RgbdSettings
from habitus.fit.points.prepared_views import Grid, PreparedView
from habitus.fit.points.skin_offsets import (
    SkinField,
    SkinPlanes,
    moved_back,
    scalp,
    scalp_at,
    skin_planes_term,
    skin_prior,
)
from habitus.mesh.normals import vertex_normals
from habitus.parallel.workers import map_on_threads
from habitus.render.draw import draw
from habitus.render.triangles import Triangles
from habitus.residuals.points import PointObservations, PointSolver
from habitus.rotations import rotvec_from_matrix
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import Minimized, Stage, alternate
from habitus.solve.terms import Term, geman_mcclure_weight


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a grid's camera would see of the model: N surface points.

    pixel (N,): number in the grid; face, barycentric: where on the surface; points, normals (N, 3):
    world.
    """

    pixel: Int[np.ndarray, " N"]
    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]
    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]


def look(grid: Grid, vertices: Float[np.ndarray, "V 3"], triangles: Triangles) -> Drawn:
    """The model's points at the centres of a grid's pixels."""
    frame = draw(grid.camera, torch.from_numpy(vertices), triangles, boundary="none", cull=True)
    ids = frame.face_ids.numpy().ravel()
    pixel = np.flatnonzero(ids >= 0)
    face = ids[pixel].astype(np.int64)
    barycentric = frame.barycentrics.numpy().reshape(-1, 3)[pixel]
    corners = triangles.faces.numpy()[face]
    points = np.einsum("nk,nkc->nc", barycentric, vertices[corners])
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Drawn(pixel, face, barycentric, points, normals)


@dataclass(frozen=True, eq=False)
class Matching:
    """Terms by name, each as points of the surface against places, and how far (m) the person's
    pixels were off.
    """

    matches: Mapping[str, PointObservations]
    distance: Float[np.ndarray, " P"]


def match(
    grid: Grid,
    drawn: Drawn,
    stage: DepthStage,
    reach: float,
    noise: float,
    settings: RgbdSettings,
    factor: Float[np.ndarray, " N"] | None = None,
) -> Matching:
    """E_D of one view and its outline, at the model as it is. factor: of the weight of each drawn
    point; None: 1.
    """
    correspondences = (_nearest if stage.matching == "nearest" else _same_pixel)(grid, drawn)
    rows, target = correspondences
    normal = drawn.normals[rows]
    point = drawn.points[rows]
    view = point - grid.eye
    depth = np.linalg.norm(view, axis=1)
    cosine = np.abs((normal * view).sum(1)) / np.maximum(depth, 1e-6)
    spread = np.hypot(noise * depth**2 * np.maximum(cosine, settings.min_cosine), settings.model_sd)
    off = ((point - target) * normal).sum(1)
    distance = (
        np.linalg.norm(point - target, axis=1) if stage.matching == "nearest" else np.abs(off)
    )
    factor = np.ones(len(drawn.face)) if factor is None else factor
    if len(distance):
        reach = max(reach, stage.scale_ratio * float(np.median(distance)))
    weight = settings.depth * grid.stride**2 / spread**2 * geman_mcclure_weight(distance, reach)
    slide = settings.slide if stage.matching == "nearest" else 0.0
    depth_term = PointObservations.to_planes(
        drawn.face[rows], drawn.barycentric[rows], target, normal, weight * factor[rows], slide
    )
    return Matching(
        {"depth": depth_term, "outline": outline(grid, drawn, reach, settings, factor)}, distance
    )


def _nearest(grid: Grid, drawn: Drawn) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the person the nearest point of the model: its row, and the pixel's own
    point.
    """
    target = grid.points[grid.person]
    if not len(drawn.points):
        return np.zeros(0, np.int64), target[:0]
    return np.asarray(KDTree(drawn.points).query(target)[1]), target


def _same_pixel(grid: Grid, drawn: Drawn) -> tuple[np.ndarray, np.ndarray]:
    own = grid.person.ravel()[drawn.pixel]
    return np.flatnonzero(own), grid.points.reshape(-1, 3)[drawn.pixel[own]]


def outline(
    grid: Grid,
    drawn: Drawn,
    reach: float,
    settings: RgbdSettings,
    factor: Float[np.ndarray, " N"],
) -> PointObservations:
    """Points of the model before what was seen through are drawn to the person's nearest pixel,
    across the view. factor: of the weight of each drawn point.
    """
    rows = wrong_rows(grid, drawn, settings.seen_through)
    pixel = drawn.pixel[rows]
    nearest = grid.nearest.reshape(2, -1)[:, pixel]
    depth = np.linalg.norm(drawn.points[rows] - grid.eye, axis=1)
    centres = np.stack([nearest[1] + 0.5, nearest[0] + 0.5], -1)
    rays = grid.camera.to_world(grid.camera.rays(torch.from_numpy(centres))).numpy() - grid.eye
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    target = grid.eye + rays * depth[:, None]
    weight = settings.outline * grid.stride**2 / settings.outline_sd**2 * factor[rows]
    weight = weight * geman_mcclure_weight(
        np.linalg.norm(target - drawn.points[rows], axis=1), max(reach, settings.min_outline_scale)
    )
    across = np.cross(rays, [0.0, 1.0, 0.0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    directions = np.stack([across, np.cross(rays, across)], 1) * np.sqrt(weight)[:, None, None]
    return PointObservations(drawn.face[rows], drawn.barycentric[rows], target, directions)


def wrong_rows(grid: Grid, drawn: Drawn, clearance: float) -> Int[np.ndarray, " n"]:
    """Points of the model that lie ``clearance`` (m) or more before what was seen through them."""
    behind, own = (image.ravel()[drawn.pixel] for image in (grid.behind, grid.person))
    depth = grid.camera.to_camera(torch.from_numpy(drawn.points)).numpy()[:, 2]
    return np.flatnonzero(~own & (behind > depth + clearance))


def person_distances(grid: Grid, drawn: Drawn) -> Float[np.ndarray, " P"]:
    """Distances (m) of the person's pixels from the nearest point of the model; infinite where none
    is drawn.
    """
    person = grid.points[grid.person]
    if not len(drawn.points):
        return np.full(len(person), np.inf)
    return np.asarray(KDTree(drawn.points).query(person)[0])


def misfit(grid: Grid, drawn: Drawn, settings: RgbdSettings = STANDARD) -> float:
    """How badly the model explains a view: mean distance (m), capped, from the person's pixels to
    the model, and the cap for each pixel of the model that was seen through.
    """
    cap = settings.search.max_misfit_distance
    distance = person_distances(grid, drawn)
    if not len(drawn.points) or not len(distance):
        return 2.0 * cap
    seen_through = len(wrong_rows(grid, drawn, settings.seen_through))
    return float(np.minimum(distance, cap).mean() + cap * seen_through / len(distance))


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
    scalp: Float[np.ndarray, " V"]

    @staticmethod
    def of(body: BodyModel, views: Sequence[PreparedView], settings: RgbdSettings) -> "DepthEnergy":
        """The energy of a body before some views."""
        triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
        hair = settings.measured_hair
        return DepthEnergy(
            body,
            tuple(views),
            settings,
            PointSolver.of(body),
            triangles,
            Footpads.of(body),
            np.zeros(body.num_vertices) if hair is None else scalp(body, hair.hairline),
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

            def of_view(k: int) -> tuple[Moving, ColourLevel] | None:
                moving = Moving.of(self.body, now.body, k, field, now.skin)
                level = ColourLevel.of(
                    self.views[k], moving.vertices, seen.shift, levels[step], looks
                )
                if level is None:
                    return None
                if field.hair.any():
                    level = level.without(moving.vertices[self.scalp > 0.5], looks.hair_margin)
                return moving, level

            views = map_on_threads(of_view, range(len(self.views)))
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

    def hair(self, state: BodyState) -> Float[np.ndarray, " V"]:
        """The thickness (V,; m) of hair over the model, the median over all views; 0 below
        `HairSettings.least_thickness`, and where it is not measured.
        """
        settings = self.settings.measured_hair
        if settings is None:
            return np.zeros(self.body.num_vertices)
        outside, distances, scalps = [], [], []
        grids = self.grids(self.settings.skin_stride)
        for grid, surface in zip(grids, self.surfaces(state), strict=True):
            points = grid.points[grid.person]
            distance, vertex = KDTree(surface).query(points)
            normal = vertex_normals(surface, self.body.faces)[vertex]
            outside.append(((points - surface[vertex]) * normal).sum(1))
            distances.append(distance)
            scalps.append(self.scalp[vertex])
        thickness = hair_thickness(
            np.concatenate(outside), np.concatenate(distances), np.concatenate(scalps), settings
        )
        return self.scalp * (thickness if thickness >= settings.least_thickness else 0.0)

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
        surfaces: Float[np.ndarray, "K V 3"],
        grids: Sequence[Grid],
        stage: DepthStage,
        scale: float,
    ) -> list[dict[str, PointObservations]]:
        """Of each view the correspondences of its pixels on surfaces, by the term's name."""

        def of_view(
            parts: tuple[PreparedView, Grid, np.ndarray],
        ) -> dict[str, PointObservations]:
            view, grid, surface = parts
            noise = self.settings.noise if view.noise is None else view.noise
            drawn = look(grid, surface, self.triangles)
            hair = scalp_at(self.scalp, self.body.faces[drawn.face], drawn.barycentric)
            factor = 1.0 - (1.0 - stage.scalp_weight) * hair
            by_term = dict(match(grid, drawn, stage, scale, noise, self.settings, factor).matches)
            if self.pads is not None and view.on_floor and stage.moves == "all":
                by_term["floor"] = self.pads.on_floor(surface, self.body, self.settings)
            return by_term

        return map_on_threads(of_view, zip(self.views, grids, surfaces, strict=True))

    def points_terms(
        self, state: BodyState, views: Sequence[Mapping[str, PointObservations]]
    ) -> dict[str, Term]:
        """The terms of correspondences around a state, without those that have none."""
        terms = {}
        for name in ("depth", "outline", "floor"):
            frames = [view.get(name) for view in views]
            frames = [None if frame is None or not len(frame.face) else frame for frame in frames]
            if any(frame is not None for frame in frames):
                terms[name] = points_around(self.solver, state, frames)
        return terms

    def _skin_terms(
        self, state: SkinnedState, means: Float[np.ndarray, "K J 3"], field: SkinField
    ) -> dict[str, Term]:
        """All terms but colour, correspondences being those of surfaces with skin and clothes."""
        settings = replace(self.settings, depth=self.settings.skin_depth)
        last = self.settings.stages[-1]
        stage = replace(
            last,
            stride=self.settings.skin_stride,
            scale_ratio=self.settings.skin_scale_ratio,
            scalp_weight=last.scalp_weight if field.hair.any() else 1.0,
        )
        models = self.surfaces(state)
        seen = field.seen(models, state.skin)
        energy = replace(self, settings=settings)
        grids = self.grids(stage.stride)
        observations = energy.observations(seen, grids, stage, self.settings.skin_scale)
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


def in_pelvis_frame(
    body: BodyModel, state: BodyState
) -> tuple[Float[np.ndarray, "K J 3"], Float[np.ndarray, "K J 3 3"]]:
    """Joints relative to the pelvis (m) and their rotations from rest, in the axes of the pelvis:
    the same in all views of a person who stands still.
    """
    joints = np.asarray(body(state.betas, state.pose, state.trans).joints)
    rotations = world_rotations(body.parents, state.pose)
    back = np.swapaxes(rotations[:, :1], -1, -2)
    return ((back @ (joints - joints[:, :1])[..., None])[..., 0], back @ rotations)


def degrees_between(
    rotations: Float[np.ndarray, "... 3 3"], others: Float[np.ndarray, "... 3 3"]
) -> Float[np.ndarray, "..."]:
    """Angles (degrees) of the rotations that take ``rotations`` to ``others``; both broadcast."""
    between = np.swapaxes(rotations, -1, -2) @ others
    return np.rad2deg(np.linalg.norm(rotvec_from_matrix(between), axis=-1))
