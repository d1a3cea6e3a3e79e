"""Body shape, poses and places from depth views (T 4.6.1): segment, start, staged Gauss-Newton steps, looks."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.rgbd.appearance import Appearance, find_appearance
from habitus.fit.rgbd.colour_camera import colour_grid, find_shift
from habitus.fit.rgbd.energy import NOTHING, Priors, State, costs_of, gauss_newton_step
from habitus.fit.rgbd.evidence import gather
from habitus.fit.rgbd.feet import Footpads
from habitus.fit.rgbd.matching import look, match, outline, trunk_faces
from habitus.fit.rgbd.result import RgbdFit
from habitus.fit.rgbd.segment import segment
from habitus.fit.rgbd.settings import STANDARD, RgbdSettings, Stage
from habitus.fit.rgbd.sights import Grid, Sight
from habitus.fit.rgbd.start import find_start
from habitus.kernels.threads import one_blas_thread
from habitus.observe.depth_views import RgbdCapture
from habitus.render.triangles import Triangles
from habitus.residuals.surface_points import PointMatches, SurfacePointSolver


@dataclass(frozen=True, eq=False)
class DepthFit:
    """Where the depth stages ended: the state, the views made ready, the cost before each step and by term before
    the last, how badly each view was explained at the start, seconds of the parts.
    """

    state: State
    sights: tuple[Sight, ...]
    costs: tuple[float, ...]
    terms: Mapping[str, float]
    start_misfit: tuple[float, ...]
    seconds: Mapping[str, float]


def fit_depth(
    capture: RgbdCapture,
    body: BodyModel,
    settings: RgbdSettings = STANDARD,
    turns: Sequence[float | None] | None = None,
) -> DepthFit:
    """Shape, poses and places from depth: E_D + outline + E_F + E_P + E_S (T eq. 4.3 without colour).

    turns: degrees by which the person is turned in each view, to the person's left; unknown ones are None.
    Raises HabitusError where nobody is found in a view, and for another number of turns than views.
    """
    with one_blas_thread():
        return _fitted(capture, body, settings, turns)


def _fitted(
    capture: RgbdCapture, body: BodyModel, settings: RgbdSettings, turns: Sequence[float | None] | None
) -> DepthFit:
    given = tuple(turns) if turns is not None else (None,) * len(capture.views)
    if len(given) != len(capture.views):
        raise HabitusError(f"{len(given)} turns for {len(capture.views)} views; give one for each")
    clock = [time.perf_counter()]
    sights = [Sight.of(view, segment(view)) for view in capture.views]
    clock.append(time.perf_counter())
    solver, triangles = SurfacePointSolver.of(body), Triangles.of(body.faces, num_vertices=body.num_vertices)
    state, means, misfits = find_start(body, solver, triangles, sights, settings, given)
    clock.append(time.perf_counter())
    priors = Priors.of(body, replace(state, pose=means), settings)
    pads, firm, costs = Footpads.of(body), trunk_faces(body), []
    for stage in settings.stages:
        grids = [sight.grid(stage.stride) for sight in sights]
        coloured = _coloured(sights, vertices_of(body, state), triangles, stage)
        for reach in np.linspace(*stage.reach, stage.steps):
            terms, surfaces = [], vertices_of(body, state)
            for k, (sight, grid) in enumerate(zip(sights, grids, strict=True)):
                drawn = look(grid, surfaces[k], triangles)
                noise = settings.noise if sight.noise is None else sight.noise
                found = match(grid, drawn, stage, reach, noise, settings).matches
                seen = _outline_in_colour(coloured[k], surfaces[k], triangles, reach, settings, firm)
                terms.append({**found, "colour_outline": seen, "floor": _floor(pads, sight, stage, settings)})
            before = state
            state, cost = gauss_newton_step(solver, state, terms, priors, stage.moves)
            costs.append(cost)
    clock.append(time.perf_counter())
    seconds = dict(zip(("segment", "start", "fit"), np.diff(clock).tolist(), strict=True))
    last = {**costs_of(solver, before, terms), **priors.costs(before)}
    return DepthFit(state, tuple(sights), tuple(costs), last, tuple(misfits), seconds)


def _coloured(
    sights: list[Sight], surfaces: Float[np.ndarray, "K V 3"], triangles: Triangles, stage: Stage
) -> list[Grid | None]:
    """The colour cameras' pixels, from where the outlines say that these cameras are."""
    some = [k for k, sight in enumerate(sights) if sight.view.background_colour is not None and stage.colour]
    if not some:
        return [None] * len(sights)
    shift = find_shift([sights[k] for k in some], [surfaces[k] for k in some], triangles).shift
    return [colour_grid(sight, shift, stage.stride) if k in some else None for k, sight in enumerate(sights)]


def _outline_in_colour(
    grid: Grid | None,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
    reach: float,
    settings: RgbdSettings,
    firm: Bool[np.ndarray, " F"],
) -> PointMatches:
    if grid is None or not settings.colour_outline:
        return NOTHING
    weighed = replace(settings, outline=settings.colour_outline)
    return outline(grid, look(grid, vertices, triangles), reach, weighed, firm)


def fit_views(
    capture: RgbdCapture,
    body: BodyModel,
    settings: RgbdSettings = STANDARD,
    turns: Sequence[float | None] | None = None,
    name: str | None = None,
    gender: str = "neutral",
) -> RgbdFit:
    """A person's shape, poses, light and albedo from views of depth and colour (T 4.6.1), and what they are worth.

    Raises HabitusError as `fit_depth`.
    """
    found = fit_depth(capture, body, settings, turns)
    began = time.perf_counter()
    surfaces = vertices_of(body, found.state)
    appearance = find_appearance(found.sights, surfaces, body.faces)
    coloured = time.perf_counter()
    evidence = gather(body, found.state, found.sights, settings.noise)
    seconds = {**found.seconds, "colour": coloured - began, "judge": time.perf_counter() - coloured}
    state = found.state
    return RgbdFit(
        capture.name,
        name or body.name,
        body,
        state.betas,
        state.pose,
        state.trans,
        found.sights,
        evidence,
        appearance,
        found.terms,
        seconds,
        asdict(settings),
        (*capture.notes, *_lost(found.sights, appearance)),
        gender,
    )


def _lost(sights: tuple[Sight, ...], appearance: Appearance | None) -> tuple[str, ...]:
    """What was not there, and what that costs."""
    notes = []
    if len(sights) == 1:
        notes.append("one view: girths rest on the shape space more than with two")
    if all(sight.view.background is None for sight in sights):
        notes.append("no shot of the empty room: the person was parted from it by planes")
    if not any(sight.on_floor for sight in sights):
        notes.append("no floor was found: height rests on what is seen, and up is the camera's")
    if appearance is None:
        notes.append("no colour: light, albedo and texture were left out")
    elif appearance.shift.overlap is None:
        notes.append("no colour of the empty room: the colour camera was taken to be where its calibration says")
    return tuple(notes)


def _floor(pads: Footpads | None, sight: Sight, stage: Stage, settings: RgbdSettings) -> PointMatches:
    if pads is None or not sight.on_floor or stage.moves != "all":
        return NOTHING
    return pads.on_floor(settings.floor / settings.floor_sd**2)


def vertices_of(body: BodyModel, state: State) -> Float[np.ndarray, "K V 3"]:
    """The surfaces of all views, each in its world (m)."""
    return body(state.betas, state.pose, state.trans).vertices
