"""Where the fit starts: place by the middle of the person's pixels, turn and arms by trying, height by the mask."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.fit.rgbd.energy import Priors, State, gauss_newton_step
from habitus.fit.rgbd.matching import look, match, misfit
from habitus.fit.rgbd.settings import RgbdSettings, Stage
from habitus.fit.rgbd.sights import Grid, Sight
from habitus.render.triangles import Triangles
from habitus.residuals.surface_points import SurfacePointSolver

STRIDE = 8
FINALISTS = 4
ROUNDS = (Stage("place", "nearest", 2, STRIDE, (0.3, 0.3)), Stage("pose", "nearest", 4, STRIDE, (0.2, 0.15)))
TALL = (1.3, 2.15)
"""Metres that grown people are tall; another height in a view is not believed."""


@dataclass(frozen=True, eq=False)
class Tried:
    """A start of one view, the pose that its prior is around, and how badly the model then explains the view."""

    state: State
    mean: Float[np.ndarray, "J 3"]
    misfit: float


def find_start(
    body: BodyModel,
    solver: SurfacePointSolver,
    triangles: Triangles,
    sights: list[Sight],
    settings: RgbdSettings,
    turns: tuple[float | None, ...],
) -> tuple[State, Float[np.ndarray, "K J 3"], list[float]]:
    """The state to start from, the poses that its priors are around, and each view's misfit.

    turns: degrees by which the person is turned from facing the camera, to the person's left; None: to be found.
    """
    betas = tall_as(body, sights)
    found = [
        _best(body, solver, triangles, sight.grid(STRIDE), betas, settings, turn)
        for sight, turn in zip(sights, turns, strict=True)
    ]
    state = State(
        betas, np.concatenate([one.state.pose for one in found]), np.concatenate([one.state.trans for one in found])
    )
    return state, np.stack([one.mean for one in found]), [one.misfit for one in found]


def tall_as(body: BodyModel, sights: list[Sight]) -> Float[np.ndarray, " B"]:
    """The likeliest betas of a person as tall as the one seen; the mean person's where that cannot be seen."""
    mean = np.zeros(body.num_betas) if body.people_mean is None else np.array(body.people_mean)
    heights = []
    for sight in sights:
        own = sight.points[sight.mask]
        if not sight.cut_off:
            low = 0.0 if sight.on_floor else np.percentile(own[:, 1], 0.3)
            heights.append(np.percentile(own[:, 1], 99.7) - low)
    heights = [height for height in heights if TALL[0] < height < TALL[1]]
    if not heights:
        return mean
    top, sole = (pick(body.v_template[:, 1]) for pick in (np.argmax, np.argmin))
    slope = body.shapedirs[top, 1] - body.shapedirs[sole, 1]
    now = np.ptp(body.rest_vertices(mean)[[top, sole], 1])
    step = (float(np.median(heights)) - now) * slope / max(float(slope @ slope), 1e-9)
    return mean + np.clip(step, -2.5, 2.5)


def _best(
    body: BodyModel,
    solver: SurfacePointSolver,
    triangles: Triangles,
    grid: Grid,
    betas: np.ndarray,
    settings: RgbdSettings,
    turn: float | None,
) -> Tried:
    """Among arms and turns the start that explains one view best after some coarse steps."""
    turns = settings.turns if turn is None else (turn,)
    started = [_placed(body, grid, betas, pose, triangles) for pose in _poses(body, turns, settings.arms)]
    for stage, kept in zip(ROUNDS, (len(started), FINALISTS), strict=True):
        started = sorted(started, key=lambda one: one.misfit)[:kept]
        started = [_stepped(body, solver, triangles, grid, one, stage, settings) for one in started]
    return min(started, key=lambda one: one.misfit)


def _poses(body: BodyModel, turns: tuple[float, ...], arms: tuple[float, ...]) -> Iterator[Float[np.ndarray, "J 3"]]:
    for turn, down in product(turns, arms):
        pose = np.zeros((body.num_joints, 3))
        pose[0, 1] = np.deg2rad(turn)
        for side, sign in (("left", -1.0), ("right", 1.0)):
            if f"{side}_shoulder" in body.joint_names:
                pose[body.joint_names.index(f"{side}_shoulder"), 2] = sign * np.deg2rad(down)
        yield pose


def _placed(
    body: BodyModel, grid: Grid, betas: np.ndarray, pose: np.ndarray, triangles: Triangles
) -> Tried:
    """The pose where the middle of what the camera would see of it is the middle of what it saw."""
    own, trans = grid.points[grid.own], np.zeros(3)
    vertices = body(betas, pose).vertices
    trans = _middle(own) - _middle(vertices)
    for _ in range(2):
        drawn = look(grid, vertices + trans, triangles)
        if len(drawn.points):
            trans = trans + _middle(own) - _middle(drawn.points)
    drawn = look(grid, vertices + trans, triangles)
    return Tried(State(betas, pose[None], trans[None]), pose, misfit(grid, drawn))


def _middle(points: np.ndarray) -> Float[np.ndarray, " 3"]:
    """Median across, middle of the height: what is seen of a person has the same extent as the model of it."""
    low, high = np.percentile(points[:, 1], (1, 99))
    return np.array([np.median(points[:, 0]), (low + high) / 2, np.median(points[:, 2])])


def _stepped(
    body: BodyModel,
    solver: SurfacePointSolver,
    triangles: Triangles,
    grid: Grid,
    one: Tried,
    stage: Stage,
    settings: RgbdSettings,
) -> Tried:
    state = one.state
    priors = Priors.of(body, replace(state, pose=one.mean[None]), settings)
    for reach in np.linspace(*stage.reach, stage.steps):
        drawn = look(grid, body(state.betas, state.pose[0], state.trans[0]).vertices, triangles)
        if not len(drawn.points):
            return replace(one, misfit=np.inf)
        matching = match(grid, drawn, stage, reach, settings.noise, settings)
        state, _ = gauss_newton_step(solver, state, [matching.matches], priors, stage.moves)
    drawn = look(grid, body(state.betas, state.pose[0], state.trans[0]).vertices, triangles)
    return Tried(state, one.mean, misfit(grid, drawn))
