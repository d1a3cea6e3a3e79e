"""Where a fit to depth views starts: a multi-start search of each view over turns and arms.

Translation by the middle of the person's pixels, height by the mask; turns x arms, placed and
scored by their misfit (`depth_energy.misfit`), the best refined in two rounds, front and
back told apart at last. 2D keypoints, where a view has them, give a start in place of the search:
joints lie a little behind the depth that is seen at them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.body.prepared import PreparedBody
from habitus.body.state import BodyState, BodySurface
from habitus.fit.points.correspondences import pose_prior
from habitus.fit.points.depth_energy import BLOCKS, DepthEnergy, Drawn, freed, look, match, misfit
from habitus.fit.points.depth_settings import STANDARD, DepthSearchSettings, DepthStage
from habitus.fit.points.prepared_views import Grid, PreparedView
from habitus.residuals.points import JointObservations, points_term
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import Stage, alternate, minimize
from habitus.solve.terms import Quadratic, Term, geman_mcclure_weight


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit starts: the state of all views, the poses that its priors are around, the misfit
    (m) of each view, and for each view the best start that faces the other way, None where its
    misfit is too large (`DepthSearchSettings.rival_misfit`).
    """

    state: BodyState
    means: Float[np.ndarray, "K J 3"]
    misfits: tuple[float, ...]
    opposite: tuple["Tried | None", ...]

    def with_view(self, k: int, other: "Tried") -> "Start":
        """With another start of view k."""
        state, means = with_view(self.state, self.means, k, other)
        misfits = (*self.misfits[:k], other.misfit, *self.misfits[k + 1 :])
        return replace(self, state=state, means=means, misfits=misfits)


@dataclass(frozen=True, eq=False)
class Tried:
    """A start of one view, the pose that its prior is around, and how badly the model then explains
    the view.
    """

    state: BodyState
    mean: Float[np.ndarray, "J 3"]
    misfit: float

    @property
    def yaw(self) -> float:
        """The turn from facing the camera's way back (rad)."""
        return yaw_of(self.state.pose[0, 0])


def with_view(
    state: BodyState, means: Float[np.ndarray, "K J 3"], k: int, view: Tried
) -> tuple[BodyState, Float[np.ndarray, "K J 3"]]:
    """The state of all views, and the poses that their priors are around, with those of one view
    replaced.
    """
    pose, trans, means = state.pose.copy(), state.trans.copy(), means.copy()
    pose[k], trans[k], means[k] = view.state.pose[0], view.state.trans[0], view.mean
    return replace(state, pose=pose, trans=trans), means


def yaw_of(root: Float[np.ndarray, " 3"]) -> float:
    """The turn (rad) of a root's rotation vector about the upright, 0 facing the camera."""
    forward = matrix_from_rotvec(root)[:, 2]
    return float(np.arctan2(forward[0], forward[2]))


def find_start(
    energy: DepthEnergy,
    turns: tuple[float | None, ...],
    given: Float[np.ndarray, "K J 3"] | None = None,
) -> Start:
    """The state to start from, and what goes with it.

    turns: degrees by which the person is turned from facing the camera, to the person's left; None:
    to be found. given: poses to start from, in place of those that are tried.
    """
    betas = scaled_to_height(energy.body, list(energy.views), energy.settings.search)
    found = [
        _best(energy, k, betas, turn, None if given is None else given[k])
        for k, turn in enumerate(turns)
    ]
    starts, opposite = zip(*found, strict=True)
    state = BodyState(
        betas,
        np.concatenate([one.state.pose for one in starts]),
        np.concatenate([one.state.trans for one in starts]),
    )
    means = np.stack([one.mean for one in starts])
    return Start(state, means, tuple(one.misfit for one in starts), opposite)


def scaled_to_height(
    body: BodyModel,
    views: list[PreparedView],
    settings: DepthSearchSettings = STANDARD.search,
) -> Float[np.ndarray, " B"]:
    """The likeliest betas of a person as tall as the one seen; the mean person's where the image
    cuts the person off, unless what is seen is already taller.
    """
    mean = np.zeros(body.num_betas) if body.people_mean is None else np.array(body.people_mean)
    top, sole = (pick(body.v_template[:, 1]) for pick in (np.argmax, np.argmin))
    now = np.ptp(body.rest_vertices(mean)[[top, sole], 1])
    heights = []
    for view in views:
        own = view.points[view.mask]
        low = 0.0 if view.on_floor else np.percentile(own[:, 1], 0.3)
        height = np.percentile(own[:, 1], 99.7) - low
        if height > now or not view.cut_off:
            heights.append(height)
    low, high = settings.heights
    heights = [height for height in heights if low < height < high]
    if not heights:
        return mean
    slope = body.shapedirs[top, 1] - body.shapedirs[sole, 1]
    step = (float(np.median(heights)) - now) * slope / max(float(slope @ slope), 1e-9)
    return mean + np.clip(step, -settings.max_beta, settings.max_beta)


def _best(
    energy: DepthEnergy,
    k: int,
    betas: np.ndarray,
    turn: float | None,
    given: Float[np.ndarray, "J 3"] | None,
) -> tuple[Tried, Tried | None]:
    """The pose that is given or that of keypoints; else, among arms and turns, the candidate with
    the smallest misfit after some steps. With it the best that faces the other way, if its misfit
    is little more.
    """
    body = energy.body
    view = energy.views[k]
    settings = energy.settings.search
    turns = settings.turns if turn is None else (turn,)
    prepared = body.prepare(betas)
    grid = view.grid(settings.stride)
    poses = list(arm_poses(body, settings.arms, settings.leg_spread))
    if given is not None:
        turns = tuple(np.rad2deg(yaw_of(given[0])) + aside for aside in settings.side_turns)
        poses = [np.concatenate([np.zeros((1, 3)), given[1:]]), *poses]
    posed = pose_of_keypoints(body, view, betas, settings) if given is None else None
    if posed is not None:
        pose, trans = posed
        start = Tried(BodyState(betas, pose[None], trans[None]), pose, np.inf)
        return refined(energy, k, prepared, start, settings.coarse[-1][1]), None
    started = [
        placed(energy, grid, prepared(pose), betas, pose, degrees)
        for pose in poses
        for degrees in turns
    ]

    def penalised(start: Tried) -> float:
        """Misfit, and a little for who turns their back."""
        return start.misfit + settings.facing * (1.0 - np.cos(start.yaw)) / 2.0

    for kept, stage in settings.coarse:
        started = sorted(started, key=lambda start: start.misfit)
        started = started[:kept] + _opposite(started)[:1]
        started = [refined(energy, k, prepared, start, stage) for start in started]
    started = sorted(started, key=penalised)
    rivals = started[:1] + _opposite(started)[:1]
    if len(rivals) > 1:
        rivals = [refined(energy, k, prepared, start, settings.fine) for start in rivals]
    best, *others = sorted(rivals, key=penalised)
    near = [one for one in others if one.misfit < settings.rival_misfit * best.misfit]
    return best, next(iter(near), None)


def _opposite(starts: list[Tried]) -> list[Tried]:
    """Those of some starts that face away from the first."""
    return [start for start in starts if np.cos(start.yaw - starts[0].yaw) < 0.0]


def arm_poses(
    body: BodyModel,
    arms: tuple[tuple[float, float, float], ...],
    leg_spread: float = STANDARD.search.leg_spread,
) -> Iterator[Float[np.ndarray, "J 3"]]:
    """A standing pose for each pose of the arms, as `arm_pose` takes them; leg_spread: degrees."""
    for held in arms:
        pose = np.zeros((body.num_joints, 3))
        for side, sign in (("left", -1.0), ("right", 1.0)):
            for joint, turned in arm_pose(*held, sign).items():
                if f"{side}_{joint}" in body.joint_names:
                    pose[body.joint_names.index(f"{side}_{joint}")] = turned
            if f"{side}_hip" in body.joint_names:
                pose[body.joint_names.index(f"{side}_hip"), 2] = np.deg2rad(-sign * leg_spread)
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


def placed(
    energy: DepthEnergy,
    grid: Grid,
    surface: BodySurface,
    betas: np.ndarray,
    pose: np.ndarray,
    degrees: float,
) -> Tried:
    """The pose turned, where the middle of what the camera would see of it is the middle of what it
    saw; then turned and moved on the floor plan until it is nearest to the observed points.
    """
    settings = energy.settings.search
    observed = grid.points[grid.person]
    tree = KDTree(observed)
    root = np.asarray(surface.joints[0])
    shape = np.asarray(surface.vertices) - root

    def drawn_at(yaw: np.ndarray, place: np.ndarray) -> Drawn:
        return look(grid, shape @ _about_y(float(yaw[0])).T + place, energy.triangles)

    def terms_at(values: dict[str, Any], stage: Stage, step: int) -> dict[str, Term]:
        return {
            "depth": planar_term(
                drawn_at(**values), observed, tree, **values, scale=settings.planar_scale
            )
        }

    yaw = np.array([np.deg2rad(degrees)])
    place = _middle(observed) - _middle(shape)
    for _ in range(settings.middle_steps):
        drawn = drawn_at(yaw, place)
        if len(drawn.points):
            place = place + _middle(observed) - _middle(drawn.points)
    limit = settings.max_planar_step
    solved = alternate(
        terms_at,
        {"yaw": yaw, "place": place},
        [Stage(settings.planar_steps, max_step={"yaw": limit, "place": limit})],
        steps=Levenberg(settings.planar_damping),
    )
    yaw, place = solved.values["yaw"], solved.values["place"]
    turned = pose.copy()
    turned[0, 1] = yaw[0]
    state = BodyState(betas, turned[None], (place - root)[None])
    return Tried(state, turned, misfit(grid, drawn_at(yaw, place), energy.settings))


def planar_term(
    drawn: Drawn,
    observed: Float[np.ndarray, "M 3"],
    tree: KDTree,
    yaw: Float[np.ndarray, " 1"],
    place: Float[np.ndarray, " 3"],
    scale: float = STANDARD.search.planar_scale,
) -> Term:
    """Drawn points of a surface against planes through the observed ones nearest to them: over the
    turn about the upright through ``place`` (rad) and ``place`` (m), around these values. scale:
    Geman-McClure's (m).

        1/2 sum_p w_p (n_p . (R(yaw - yaw0) (p - place0) + place - t_p))^2
    """
    arms = drawn.points - place
    turning = np.stack([arms[:, 2], np.zeros(len(arms)), -arms[:, 0]], 1)
    columns = np.column_stack([(turning * drawn.normals).sum(1), drawn.normals])
    distance, row = tree.query(drawn.points)
    weight = geman_mcclure_weight(distance, scale)
    missing = ((observed[row] - drawn.points) * drawn.normals).sum(1)
    matrix = (columns * weight[:, None]).T @ columns
    pull = (columns * weight[:, None]).T @ missing
    square = float(weight @ missing**2)
    start = np.concatenate([yaw, place])

    def residual(yaw: np.ndarray, place: np.ndarray) -> Quadratic:
        step = np.concatenate([yaw, place]) - start
        slope = matrix @ step - pull
        cost = 0.5 * (square + float(step @ (slope - pull)))
        blocks = {
            ("yaw", "yaw"): matrix[:1, :1],
            ("yaw", "place"): matrix[:1, 1:],
            ("place", "place"): matrix[1:, 1:],
        }
        return Quadratic(cost, lambda: ({"yaw": slope[:1], "place": slope[1:]}, blocks))

    return Term(residual)


def _about_y(angle: float) -> Float[np.ndarray, "3 3"]:
    return matrix_from_rotvec(np.array([0.0, angle, 0.0]))


def _middle(points: np.ndarray) -> Float[np.ndarray, " 3"]:
    """Median across, middle of the height: what is seen of a person has the same extent as the
    model of it.
    """
    low, high = np.percentile(points[:, 1], (1, 99))
    return np.array([np.median(points[:, 0]), (low + high) / 2, np.median(points[:, 2])])


def refined(
    energy: DepthEnergy, k: int, prepared: PreparedBody, start: Tried, stage: DepthStage
) -> Tried:
    """A candidate of view k after the steps of a stage, by depth and outline."""
    settings = energy.settings
    grid = energy.views[k].grid(stage.stride)
    prior = energy.priors(start.mean[None])["pose"]

    def drawn_at(state: BodyState) -> Drawn:
        surface = prepared(state.pose[0], state.trans[0]).vertices
        return look(grid, surface, energy.triangles)

    def terms_at(values: dict[str, Any], stage: DepthStage, step: int) -> dict[str, Term]:
        scale = float(np.linspace(*stage.scales, stage.steps)[step])
        now = BodyState(**values)
        by_term = match(grid, drawn_at(now), stage, scale, settings.noise, settings).matches
        return {**energy.points_terms(now, [by_term]), "pose": prior}

    solved = alternate(
        terms_at,
        start.state,
        [freed(stage, energy.body, settings)],
        steps=Levenberg(settings.damping),
        blocks=BLOCKS,
    )
    drawn = drawn_at(solved.state)
    worst = misfit(grid, drawn, settings) if len(drawn.points) else np.inf
    return Tried(solved.state, start.mean, worst)


def pose_of_keypoints(
    body: BodyModel,
    view: PreparedView,
    betas: Float[np.ndarray, " B"],
    settings: DepthSearchSettings = STANDARD.search,
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " 3"]] | None:
    """Pose and place at which the body's joints are where a view's keypoints say; None where too
    few say so.
    """
    joints, points = seen_joints(body, view, settings)
    if len(joints) < settings.min_keypoints:
        return None
    located = [
        _solved(body, betas, joints, points, turn, settings)
        for turn in np.deg2rad([0.0, 90.0, 180.0, 270.0])
    ]
    return min(located, key=lambda one: one[2])[:2]


def seen_joints(
    body: BodyModel, view: PreparedView, settings: DepthSearchSettings = STANDARD.search
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Joints that keypoints name, and where they are in the world (m), by the depth beside them."""
    joints = []
    points = []
    if view.colour_camera is None or not view.view.keypoints:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    own = view.points[view.mask]
    tree = KDTree(view.colour_camera.project(torch.from_numpy(own))[0].numpy())
    for name, (u, v, confidence) in view.view.keypoints.items():
        part = name.partition("_")[2]
        near = tree.query_ball_point((u, v), settings.keypoint_pixels)
        known = part in settings.joint_depths and name in body.joint_names
        if confidence < settings.min_confidence or not known or not near:
            continue
        skin = np.median(own[near], axis=0)
        direction = (skin - view.eye) / np.linalg.norm(skin - view.eye)
        joints.append(body.joint_names.index(name))
        points.append(skin + settings.joint_depths[part] * direction)
    return np.array(joints, np.int64), np.array(points).reshape(-1, 3)


def _solved(
    body: BodyModel,
    betas: np.ndarray,
    joints: np.ndarray,
    points: np.ndarray,
    turn: float,
    settings: DepthSearchSettings,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Pose, translation and cost from a turn."""
    pose = np.zeros((1, body.num_joints, 3))
    pose[0, 0] = rotvec_from_matrix(matrix_from_rotvec(np.array([0.0, turn, 0.0])))
    trans = points.mean(0) - body.rest_joints(betas)[joints].mean(0)
    precision = np.full(pose.size, settings.keypoint_joint_sd**-2.0)
    precision[:3] = 1e-6
    count = len(joints)
    directions = np.tile(np.eye(3) / settings.keypoint_sd, (count, 1, 1))
    seen = JointObservations(joints, np.zeros((count, 3)), points, directions)
    solution = minimize(
        {
            "joints": points_term(body, [seen]),
            "pose": pose_prior(np.zeros(pose.size), np.diag(precision)),
        },
        BodyState(betas, pose, trans[None]),
        "levenberg",
        fixed=("betas",),
        max_step={"pose": settings.max_joint_step},
        max_iterations=settings.keypoint_steps,
        blocks=BLOCKS,
    )
    return solution.state.pose[0], solution.state.trans[0], solution.cost
