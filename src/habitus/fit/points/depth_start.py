"""Where the fit starts: place by the middle of the person's pixels, turn and arms by trying, height
by the mask.

A start from 2D keypoints: joints lie a little behind the depth that is seen at them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.prepared import PreparedBody
from habitus.body.state import BodySurface
from habitus.fit.points.depth_correspondences import Drawn, look, match, misfit
from habitus.fit.points.depth_energy import Priors, gauss_newton_step
from habitus.fit.points.prepared_views import Grid, Sight
from habitus.fit.points.settings import RgbdSettings, Stage
from habitus.fit.points.state import State
from habitus.render.triangles import Triangles
from habitus.residuals.points import PointSolver
from habitus.residuals.robust import geman_mcclure_weight
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

STRIDE = 8
COARSE = (
    (12, Stage("pose", "nearest", 2, STRIDE, (0.3, 0.2))),
    (4, Stage("pose", "nearest", 4, STRIDE, (0.2, 0.15))),
)
"""How many starts go on, and the steps they then make."""
FINE = Stage("pose", "nearest", 4, 4, (0.15, 0.1))
"""Steps after which front and back are told apart."""
FACING = 0.003
APART = 7.0
"""Degrees that each leg stands outwards."""
ASIDE = (0.0, 30.0, -30.0)
"""Degrees about a turn that was given."""
TURNING = 3
"""Steps in which the whole body turns and moves, before joints are let go."""
TALL = (1.3, 2.15)
"""Metres that grown people are tall; another height in a view is not believed."""


@dataclass(frozen=True, eq=False)
class Tried:
    """A start of one view, the pose that its prior is around, and how badly the model then explains
    the view.
    """

    state: State
    mean: Float[np.ndarray, "J 3"]
    misfit: float

    @property
    def yaw(self) -> float:
        """The turn from facing the camera's way back (rad)."""
        return _yaw(self.state.pose[0, 0])


def _yaw(root: Float[np.ndarray, " 3"]) -> float:
    forward = matrix_from_rotvec(root)[:, 2]
    return float(np.arctan2(forward[0], forward[2]))


def find_start(
    body: BodyModel,
    solver: PointSolver,
    triangles: Triangles,
    sights: list[Sight],
    settings: RgbdSettings,
    turns: tuple[float | None, ...],
    given: Float[np.ndarray, "K J 3"] | None = None,
) -> tuple[State, Float[np.ndarray, "K J 3"], list[float]]:
    """The state to start from, the poses that its priors are around, and each view's misfit.

    turns: degrees by which the person is turned from facing the camera, to the person's left; None:
    to be found. given: poses to start from, in place of those that are tried.
    """
    betas = tall_as(body, sights)
    found = []
    for k, (sight, turn) in enumerate(zip(sights, turns, strict=True)):
        own = None if given is None else given[k]
        found.append(_best(body, solver, triangles, sight, betas, settings, turn, own))
    state = State(
        betas,
        np.concatenate([one.state.pose for one in found]),
        np.concatenate([one.state.trans for one in found]),
    )
    return state, np.stack([one.mean for one in found]), [one.misfit for one in found]


def tall_as(body: BodyModel, sights: list[Sight]) -> Float[np.ndarray, " B"]:
    """The likeliest betas of a person as tall as the one seen; the mean person's where that cannot
    be seen.
    """
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
    solver: PointSolver,
    triangles: Triangles,
    sight: Sight,
    betas: np.ndarray,
    settings: RgbdSettings,
    turn: float | None,
    given: Float[np.ndarray, "J 3"] | None,
) -> Tried:
    """The pose that is given or that keypoints tell; else, among arms and turns, what explains one
    view best after some steps.
    """
    turns = settings.turns if turn is None else (turn,)
    prepared = body.prepare(betas)
    grid = sight.grid(STRIDE)
    poses = list(arm_poses(body, settings.arms))
    if given is not None:
        turns = tuple(np.rad2deg(_yaw(given[0])) + aside for aside in ASIDE)
        poses = [np.concatenate([np.zeros((1, 3)), given[1:]]), *poses]
    told = pose_of_keypoints(body, sight, betas) if given is None else None
    if told is not None:
        pose, trans = told
        one = Tried(State(betas, pose[None], trans[None]), pose, np.inf)
        return refined(body, prepared, solver, triangles, grid, one, COARSE[-1][1], settings)
    started = [
        _placed(grid, triangles, prepared(pose), betas, pose, degrees)
        for pose in poses
        for degrees in turns
    ]
    for kept, stage in COARSE:
        started = sorted(started, key=lambda one: one.misfit)[:kept]
        started = [
            refined(body, prepared, solver, triangles, grid, one, stage, settings)
            for one in started
        ]
    started = sorted(started, key=_doubt)
    opposite = [one for one in started if np.cos(one.yaw - started[0].yaw) < 0.0]
    finer = sight.grid(FINE.stride)
    rivals = started[:1] + opposite[:1]
    if len(rivals) > 1:
        rivals = [
            refined(body, prepared, solver, triangles, finer, one, FINE, settings) for one in rivals
        ]
    return min(rivals, key=_doubt)


def _doubt(one: Tried) -> float:
    """Misfit, and a little for who turns their back: from front and back people look alike but for
    nose and toes.
    """
    return one.misfit + FACING * (1.0 - np.cos(one.yaw)) / 2.0


def arm_poses(
    body: BodyModel, arms: tuple[tuple[float, float, float], ...]
) -> Iterator[Float[np.ndarray, "J 3"]]:
    """A standing pose for each way to hold the arms, as `arm_pose` takes them."""
    for held in arms:
        pose = np.zeros((body.num_joints, 3))
        for side, sign in (("left", -1.0), ("right", 1.0)):
            for joint, turned in arm_pose(*held, sign).items():
                if f"{side}_{joint}" in body.joint_names:
                    pose[body.joint_names.index(f"{side}_{joint}")] = turned
            if f"{side}_hip" in body.joint_names:
                pose[body.joint_names.index(f"{side}_hip"), 2] = np.deg2rad(-sign * APART)
        yield pose


def arm_pose(
    down: float, bent: float, inwards: float, sign: float
) -> dict[str, Float[np.ndarray, " 3"]]:
    """Rotation vectors of shoulder and elbow for an arm of the T-pose that is so many degrees below
    the level, bent at the elbow, and turned inwards about the upper arm. sign: -1 for the left arm,
    1 for the right.
    """
    down, bent, inwards = np.deg2rad([down, bent, inwards])
    lowered = matrix_from_rotvec(np.array([0.0, 0.0, sign * down]))
    twisted = matrix_from_rotvec(np.array([inwards, 0.0, 0.0]))
    return {
        "shoulder": rotvec_from_matrix(lowered @ twisted),
        "elbow": np.array([0.0, sign * bent, 0.0]),
    }


def _placed(
    grid: Grid,
    triangles: Triangles,
    surface: BodySurface,
    betas: np.ndarray,
    pose: np.ndarray,
    degrees: float,
) -> Tried:
    """The pose turned, where the middle of what the camera would see of it is the middle of what it
    saw; then turned and moved on the floor plan as the nearest points ask.
    """
    own = grid.points[grid.own]
    root = np.asarray(surface.joints[0])
    shape = np.asarray(surface.vertices) - root
    yaw = np.deg2rad(degrees)
    where = _middle(own) - _middle(shape)
    tree = KDTree(own)
    for step in range(2 + TURNING):
        drawn = look(grid, shape @ _about_y(yaw).T + where, triangles)
        if not len(drawn.points):
            break
        if step < 2:
            where = where + _middle(own) - _middle(drawn.points)
        else:
            turned, moved = _planar_step(drawn, own, tree, where)
            yaw = yaw + turned
            where = where + moved
    drawn = look(grid, shape @ _about_y(yaw).T + where, triangles)
    found = pose.copy()
    found[0, 1] = yaw
    return Tried(State(betas, found[None], (where - root)[None]), found, misfit(grid, drawn))


def _planar_step(
    drawn: Drawn, own: np.ndarray, tree: KDTree, middle: np.ndarray
) -> tuple[float, Float[np.ndarray, " 3"]]:
    """A turn about the upright through ``middle`` and a move, towards planes through the nearest
    points.
    """
    distance, row = tree.query(drawn.points)
    root = geman_mcclure_weight(distance, 0.3) ** 0.5
    arm = drawn.points - middle
    columns = np.stack(
        [arm[:, 2] * drawn.normals[:, 0] - arm[:, 0] * drawn.normals[:, 2], *drawn.normals.T], 1
    )
    residual = ((own[row] - drawn.points) * drawn.normals).sum(1)
    normal = (columns * root[:, None] ** 2).T @ columns + np.diag([1e-3, 1e-6, 1e-6, 1e-6]) * len(
        residual
    )
    step = np.linalg.solve(normal, (columns * root[:, None] ** 2).T @ residual)
    return float(np.clip(step[0], -0.3, 0.3)), np.clip(step[1:], -0.3, 0.3)


def _about_y(angle: float) -> Float[np.ndarray, "3 3"]:
    return matrix_from_rotvec(np.array([0.0, angle, 0.0]))


def _middle(points: np.ndarray) -> Float[np.ndarray, " 3"]:
    """Median across, middle of the height: what is seen of a person has the same extent as the
    model of it.
    """
    low, high = np.percentile(points[:, 1], (1, 99))
    return np.array([np.median(points[:, 0]), (low + high) / 2, np.median(points[:, 2])])


def refined(
    body: BodyModel,
    prepared: PreparedBody,
    solver: PointSolver,
    triangles: Triangles,
    grid: Grid,
    one: Tried,
    stage: Stage,
    settings: RgbdSettings,
) -> Tried:
    """Joints let go, on few pixels."""
    state = one.state
    priors = Priors.of(body, replace(state, pose=one.mean[None]), settings)
    for reach in np.linspace(*stage.reach, stage.steps):
        drawn = look(grid, prepared(state.pose[0], state.trans[0]).vertices, triangles)
        if not len(drawn.points):
            return replace(one, misfit=np.inf)
        matching = match(grid, drawn, stage, reach, settings.noise, settings)
        state, _ = gauss_newton_step(solver, state, [matching.matches], priors, stage.moves)
    drawn = look(grid, prepared(state.pose[0], state.trans[0]).vertices, triangles)
    return Tried(state, one.mean, misfit(grid, drawn))


DEPTHS = {"shoulder": 0.06, "elbow": 0.04, "wrist": 0.03, "hip": 0.09, "knee": 0.06, "ankle": 0.05}
"""Metres that a joint lies behind the skin."""
SURE = 0.3
PIXELS = 6.0
"""How near a depth pixel must be to a keypoint, in colour pixels."""
STEPS = 15
JOINT_SD = 0.5
POINT_SD = 0.03
LONGEST = 0.6
FEWEST = 6


def pose_of_keypoints(
    body: BodyModel, sight: Sight, betas: Float[np.ndarray, " B"]
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " 3"]] | None:
    """Pose and place at which the body's joints are where a view's keypoints say; None where too
    few say so.
    """
    joints, points = seen_joints(body, sight)
    if len(joints) < FEWEST:
        return None
    found = [
        _solved(body, betas, joints, points, turn) for turn in np.deg2rad([0.0, 90.0, 180.0, 270.0])
    ]
    return min(found, key=lambda one: one[2])[:2]


def seen_joints(
    body: BodyModel, sight: Sight
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Joints that keypoints name, and where they are in the world (m), by the depth beside them."""
    joints = []
    points = []
    if sight.colour_camera is None or not sight.view.keypoints:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    own = sight.points[sight.mask]
    tree = KDTree(sight.colour_camera.project(torch.from_numpy(own))[0].numpy())
    for name, (u, v, sure) in sight.view.keypoints.items():
        part = name.partition("_")[2]
        near = tree.query_ball_point((u, v), PIXELS)
        if sure < SURE or part not in DEPTHS or name not in body.joint_names or not near:
            continue
        skin = np.median(own[near], axis=0)
        away = (skin - sight.eye) / np.linalg.norm(skin - sight.eye)
        joints.append(body.joint_names.index(name))
        points.append(skin + DEPTHS[part] * away)
    return np.array(joints, np.int64), np.array(points).reshape(-1, 3)


def _solved(
    body: BodyModel, betas: np.ndarray, joints: np.ndarray, points: np.ndarray, turn: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Gauss-Newton from a turn: pose, place and what is left."""
    pose = np.zeros((body.num_joints, 3))
    trans = points.mean(0) - body.rest_joints(betas)[joints].mean(0)
    pose[0] = rotvec_from_matrix(matrix_from_rotvec(np.array([0.0, turn, 0.0])))
    prior = np.concatenate([np.zeros(3), np.full(pose.size, JOINT_SD**-2.0)])
    prior[3:6] = 1e-6
    for _ in range(STEPS):
        found = surface_jacobian(body, betas, pose, trans, vertices=[0])
        apart = (found.surface.joints[joints] - points).ravel()
        rows = np.concatenate(
            [
                np.tile(np.eye(3), (len(joints), 1)),
                found.joints_pose[joints].reshape(-1, pose.size),
            ],
            1,
        )
        gradient = rows.T @ apart / POINT_SD**2 + prior * np.concatenate(
            [np.zeros(3), pose.ravel()]
        )
        step = -np.linalg.solve(rows.T @ rows / POINT_SD**2 + np.diag(prior + 1e-6), gradient)
        step *= min(1.0, LONGEST / max(float(np.abs(step[3:]).max()), 1e-9))
        trans = trans + step[:3]
        pose = pose + step[3:].reshape(pose.shape)
    return pose, trans, float(apart @ apart / POINT_SD**2 + (prior[3:] * pose.ravel() ** 2).sum())
