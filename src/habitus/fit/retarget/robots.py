"""A body's motion on a humanoid robot: whole-sequence inverse kinematics within the limits of its
joints, with feet that stand where they stand.

    minimise over the poses of all frames   directions of links + footprints + hips + floor
                                            + clearance + acceleration
    subject to                              limits of angles and of their speeds
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.motion import BodyMotion
from habitus.body.robot import LinkPoses, Robot
from habitus.errors import HabitusError, listed
from habitus.fit.retarget.contacts import ContactSettings
from habitus.fit.retarget.robot_goal import (
    Footprints,
    Person,
    footprints,
    leg_of,
    palm_prints,
    person_of,
)
from habitus.fit.retarget.robot_kernels import frame_costs, linearized
from habitus.fit.retarget.robot_pairs import REQUIRED, RobotPairs, Sole
from habitus.rotations import matrix_from_rotvec
from habitus.solve.banded import BandedOptions, solve_banded

ROOT = 6


@dataclass(frozen=True)
class RobotSettings:
    """Weights of squares (directions are unit vectors, so that 1 is a radian), and the rest."""

    stand: float = 3e6
    """1/m², of where the heel and the toes of a foot that stands, and hands at rest, are on the
    ground."""
    level: float = 3e3
    """1/m², of the height of each point of a sole that stands: an ankle that cannot lay the foot
    flat lets it stand on its edge."""
    swing: float = 100.0
    """1/m², of the middle of a foot that does not."""
    hips: float = 25.0
    """1/m², of the middle of the hips, whose way is scaled with the legs."""
    floor: float = 1e4
    """1/m², of what is below the ground."""
    clearance: float = 3e3
    """1/m², of how far capsules enter one another."""
    neutral: float = 1e-3
    """1/rad², of every joint's angle: for joints that nothing else determines."""
    acceleration: float = 7e-4
    """s²: of joints' angles; 50 rad/s² cost as much as 2 degrees."""
    root_acceleration: float = 3e-3
    """s²/m, and s² of its turn: of how the root differs from the person's."""
    margin: float = 1e-6
    """rad and rad/s by which limits are kept, so that rounding passes none."""
    contacts: ContactSettings = field(default_factory=ContactSettings)
    schedule: tuple[tuple[float, BandedOptions], ...] = (
        (3e-3, BandedOptions(stride=8, steps=30, damping=1.0)),
        (3e-3, BandedOptions(steps=15)),
        (0.1, BandedOptions(steps=15, damping=1.0)),
        (1.0, BandedOptions(steps=15, tolerance=2e-5, damping=1.0)),
    )
    """Stages of the solver, each with a share of the weight of ``stand``; damped where that weight
    rises: undamped steps then overshoot, and where they stall depends on rounding."""


ROBOT = RobotSettings()


class _Tree(NamedTuple):
    """The robot as kernels take it; ``path_axes`` lists, link by link, what turns it."""

    parents: np.ndarray
    offsets: np.ndarray
    turns: np.ndarray
    joint_of_link: np.ndarray
    axes: np.ndarray
    anchors: np.ndarray
    path_starts: np.ndarray
    path_axes: np.ndarray


class _Goal(NamedTuple):
    """The targets as kernels take them; weights are of half squares."""

    references: np.ndarray
    starts: np.ndarray
    direction_links: np.ndarray
    direction_axes: np.ndarray
    direction_weights: np.ndarray
    directions: np.ndarray
    point_links: np.ndarray
    point_places: np.ndarray
    point_weights: np.ndarray
    point_up_weights: np.ndarray
    points: np.ndarray
    floor_links: np.ndarray
    floor_places: np.ndarray
    floor_radii: np.ndarray
    floor_weight: float
    capsule_links: np.ndarray
    capsule_ends: np.ndarray
    capsule_radii: np.ndarray
    capsule_lengths: np.ndarray
    pairs: np.ndarray
    clearance_weight: float
    neutral: np.ndarray
    neutral_weights: np.ndarray


class _Work(NamedTuple):
    """Room for one frame."""

    turns: np.ndarray
    origins: np.ndarray
    axes: np.ndarray
    anchors: np.ndarray
    columns: np.ndarray
    used: np.ndarray
    ends: np.ndarray


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """A robot in motion: T frames, n joints; metres, radians, z up from the ground at 0.

    ``root`` (T, 3) is the origin of the root link, ``turn`` (T, 3, 3) its rotation, ``angles``
    (T, n) are in the order of ``robot.joint_names``.
    """

    robot: Robot
    root: Float[np.ndarray, "T 3"]
    turn: Float[np.ndarray, "T 3 3"]
    angles: Float[np.ndarray, "T n"]
    rate_hz: float

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.angles)

    def links(self) -> LinkPoses:
        """Places of all links in every frame."""
        return self.robot.pose(self.angles, self.root, self.turn)


@dataclass(frozen=True, eq=False)
class RobotRetargeting:
    """A robot's motion, what it was made to follow, and how the solver ended.

    ``scale``: of all places, the robot's legs to the person's. ``prints``: the targets of the left
    and the right foot. ``status`` and ``iterations``: of the last stage
    (`habitus.solve.banded.BandedSolution`).
    """

    motion: RobotMotion
    pairs: RobotPairs
    person: Person
    prints: tuple[Footprints, Footprints]
    scale: float
    status: str
    iterations: int


def retargeted_to_robot(
    motion: BodyMotion, robot: Robot, pairs: RobotPairs, settings: RobotSettings = ROBOT
) -> RobotRetargeting:
    """The motion on a robot, its way scaled with the legs.

    Raises HabitusError where the table does not fit the robot, or the body has no legs.
    """
    check_pairs(robot, pairs)
    person = person_of(motion, pairs, settings.contacts)
    leg, _ = leg_of(robot, pairs)
    scale = leg / person.leg
    origin = person.hips[0] * (1.0, 1.0, 0.0)
    left, right = (
        footprints(person.soles[:, k], person.still[:, k], sole, scale, origin)
        for k, sole in enumerate(pairs.soles)
    )
    return solve_robot(robot, pairs, person, (left, right), scale, motion.rate_hz, settings)


def solve_robot(
    robot: Robot,
    pairs: RobotPairs,
    person: Person,
    prints: tuple[Footprints, Footprints],
    scale: float,
    rate_hz: float,
    settings: RobotSettings = ROBOT,
) -> RobotRetargeting:
    """The robot's motion that follows a person's directions and footprints."""
    states = np.zeros((len(person.hips), ROOT + robot.num_joints))
    for share, options in settings.schedule:
        soft = replace(settings, stand=share * settings.stand)
        goal = robot_goal(robot, pairs, person, prints, scale, soft)
        problem = RobotProblem(robot, goal, rate_hz, pairs, settings)
        solution = solve_banded(problem, states, options)
        states = solution.states
    angles = states[:, ROOT:]
    turn = matrix_from_rotvec(states[:, 3:ROOT]) @ goal.references
    made = RobotMotion(robot, goal.starts + states[:, :3], turn, angles, rate_hz)
    return RobotRetargeting(
        made, pairs, person, prints, scale, solution.status, solution.iterations
    )


def check_pairs(robot: Robot, pairs: RobotPairs) -> None:
    """Raise HabitusError where a table of pairs does not fit a robot."""
    missing = pairs.missing(robot)
    if missing:
        raise HabitusError(
            f"the table {pairs.name} names {listed(missing)}, which the robot {robot.name} lacks; "
            f"its links: {listed(robot.link_names, 40)}"
        )
    absent = [name for name in REQUIRED if name not in pairs.segments]
    if absent:
        raise HabitusError(
            f"the table {pairs.name} names no link for {listed(absent)}; expected at least "
            f"{listed(REQUIRED)}"
        )


def _local(robot: Robot, link: int, places: np.ndarray) -> np.ndarray:
    """From the axes of the robot at zero into a link's own."""
    return places @ robot.zero.rotations[link]


def robot_goal(
    robot: Robot,
    pairs: RobotPairs,
    person: Person,
    prints: tuple[Footprints, Footprints],
    scale: float,
    settings: RobotSettings,
) -> _Goal:
    """The targets of all frames as arrays."""
    _, between = leg_of(robot, pairs)
    origin = person.hips[0] * (1.0, 1.0, 0.0)
    hips = origin + scale * (person.hips - origin)
    rooted = [name for name, part in pairs.segments.items() if part.link == robot.link_names[0]]
    references = person.frames[rooted[0] if rooted else "pelvis"]
    pelvis = robot.link(pairs.segments["pelvis"].link)
    hips_at_zero = robot.zero.origins[pelvis] + between
    starts = hips - references @ hips_at_zero
    directions = [
        (robot.link(part.link), axis, part.weight, person.directions[name, kind])
        for name, part in pairs.segments.items()
        for kind, axis in part.directions.items()
    ]
    always = np.full(len(hips), settings.hips)
    points = [_Point(pelvis, between, always, always, hips)]
    for sole, made in zip(pairs.soles, prints, strict=True):
        points += _sole_points(robot.link(sole.link), sole, made, settings)
    points += _palm_points(robot, pairs, person, scale, settings)
    floor = floor_points(robot, pairs)
    capsules = list(pairs.capsules.values())
    ends = [_local(robot, robot.link(part.link), part.ends) for part in capsules]
    lengths = [np.linalg.norm(part.ends[1] - part.ends[0]) for part in capsules]
    return _Goal(
        references=np.ascontiguousarray(references),
        starts=starts,
        direction_links=np.array([link for link, *_ in directions]),
        direction_axes=np.array([_local(robot, link, axis) for link, axis, *_ in directions]),
        direction_weights=np.array([weight for _, _, weight, _ in directions]),
        directions=np.ascontiguousarray(np.stack([way for *_, way in directions], axis=1)),
        point_links=np.array([point.link for point in points]),
        point_places=np.array([_local(robot, point.link, point.place) for point in points]),
        point_weights=np.stack([point.level_weight for point in points], axis=1),
        point_up_weights=np.stack([point.up_weight for point in points], axis=1),
        points=np.ascontiguousarray(np.stack([point.target for point in points], axis=1)),
        floor_links=np.array([link for link, *_ in floor]),
        floor_places=np.array([_local(robot, link, place) for link, place, _ in floor]),
        floor_radii=np.array([radius for *_, radius in floor]),
        floor_weight=settings.floor,
        capsule_links=np.array([robot.link(part.link) for part in capsules], dtype=np.int64),
        capsule_ends=np.array(ends).reshape(-1, 2, 3),
        capsule_radii=np.array([part.radius for part in capsules], dtype=float),
        capsule_lengths=np.array(lengths, dtype=float),
        pairs=clear_pairs(robot, pairs),
        clearance_weight=settings.clearance,
        neutral=np.zeros(ROOT + robot.num_joints),
        neutral_weights=np.full(ROOT + robot.num_joints, settings.neutral),
    )


class _Point(NamedTuple):
    """A place on a link (m from its origin at zero), its target (T, 3), and weights (T,) of the
    level and of the upright residual.
    """

    link: int
    place: np.ndarray
    level_weight: np.ndarray
    up_weight: np.ndarray
    target: np.ndarray


def _sole_points(link: int, sole: Sole, made: Footprints, settings: RobotSettings) -> list[_Point]:
    """Heights of a sole's corners and level places of heel and toes while they stand, and the
    foot's middle while nothing of it stands.
    """
    corners = np.concatenate([sole.heel, sole.toes])
    never = np.zeros(len(made.stands))
    out = [
        _Point(link, corner, never, settings.level * made.stands[:, k], made.targets[:, k])
        for k, corner in enumerate(corners)
    ]
    for part in (slice(0, len(sole.heel)), slice(len(sole.heel), None)):
        stand = np.where(made.stands[:, part].any(axis=1), settings.stand, 0.0)
        where = np.asarray(made.targets[:, part].mean(axis=1))
        out.append(_Point(link, corners[part].mean(axis=0), stand, never, where))
    free = np.where(made.stands.any(axis=1), 0.0, settings.swing)
    return [*out, _Point(link, sole.middle, free, free, made.middle)]


def _palm_points(
    robot: Robot, pairs: RobotPairs, person: Person, scale: float, settings: RobotSettings
) -> list[_Point]:
    """Contacts of hands with the ground; none for a robot whose table has no capsules for them."""
    origin = person.hips[0] * (1.0, 1.0, 0.0)
    out = []
    for k, side in enumerate(("left", "right")):
        part = pairs.capsules.get(f"{side}_hand")
        resting = person.resting[:, k]
        if part is None or not resting.any():
            continue
        where = palm_prints(person.palms[:, k], resting, scale, origin, part.radius)
        stand = np.where(resting, settings.stand, 0.0)
        level = np.where(resting, settings.level, 0.0)
        out.append(_Point(robot.link(part.link), part.ends.mean(axis=0), stand, level, where))
    return out


def floor_points(robot: Robot, pairs: RobotPairs) -> list[tuple[int, np.ndarray, float]]:
    """Links, places and radii of what stays above the ground: soles, and capsules of other
    links.
    """
    soled = {sole.link for sole in pairs.soles}
    soles = [
        (robot.link(sole.link), corner, 0.0)
        for sole in pairs.soles
        for corner in (*sole.heel, *sole.toes)
    ]
    return soles + [
        (robot.link(part.link), end, part.radius)
        for part in pairs.capsules.values()
        if part.link not in soled
        for end in part.ends
    ]


def clear_pairs(robot: Robot, pairs: RobotPairs) -> np.ndarray:
    """Pairs (K, 2) of capsules that are to keep clear: all that do so with joints at zero and are
    not neighbours.
    """
    capsules = list(pairs.capsules.values())
    chosen = np.array([(a, b) for a in range(len(capsules)) for b in range(a)], dtype=np.int64)
    chosen = chosen.reshape(-1, 2)
    places = [robot.zero.origins[robot.link(part.link)] + part.ends for part in capsules]
    ends = np.array(places).reshape(-1, 2, 3)
    radii = np.array([part.radius for part in capsules])
    gaps = segment_distance(ends[chosen[:, 0]], ends[chosen[:, 1]]) - radii[chosen].sum(axis=1)
    return chosen[gaps > 0.0]


def segment_distance(
    first: Float[np.ndarray, "*batch 2 3"], second: Float[np.ndarray, "*batch 2 3"]
) -> Float[np.ndarray, " *batch"]:
    """The distance between segments: the least of ends to segments, and between their lines where
    these come nearest inside.
    """
    u, v = first[..., 1, :] - first[..., 0, :], second[..., 1, :] - second[..., 0, :]
    w = first[..., 0, :] - second[..., 0, :]
    a, b, c = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    d, e = (u * w).sum(-1), (v * w).sum(-1)
    spread = np.maximum(a * c - b * b, 1e-12)
    s, t = (b * e - c * d) / spread, (a * e - b * d) / spread
    inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    lines = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    best = np.where(inside, lines, np.inf)
    for one, other in ((first, second), (second, first)):
        way = other[..., 1, :] - other[..., 0, :]
        for end in (0, 1):
            from_start = one[..., end, :] - other[..., 0, :]
            share = (from_start * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-12)
            gap = from_start - np.clip(share, 0.0, 1.0)[..., None] * way
            best = np.minimum(best, np.linalg.norm(gap, axis=-1))
    return best


class RobotProblem:
    """The sequence as `solve_banded` asks for it."""

    def __init__(
        self, robot: Robot, goal: _Goal, rate_hz: float, pairs: RobotPairs, settings: RobotSettings
    ):
        self._tree = _tree(robot)
        self._goal = goal
        size = ROOT + robot.num_joints
        columns = 3 + 3 + robot.num_joints
        self._work = _Work(
            turns=np.empty((robot.num_links, 3, 3)),
            origins=np.empty((robot.num_links, 3)),
            axes=np.empty((3 + robot.num_joints, 3)),
            anchors=np.empty((3 + robot.num_joints, 3)),
            columns=np.empty((columns, 3)),
            used=np.empty(columns, dtype=np.int64),
            ends=np.empty((len(goal.capsule_links), 2, 3)),
        )
        velocity = np.where(np.isfinite(robot.velocity), robot.velocity, pairs.velocity)
        free = np.full(ROOT, np.inf)
        self.lower = np.concatenate([-free, robot.lower + settings.margin])
        self.upper = np.concatenate([free, robot.upper - settings.margin])
        self.change = np.concatenate([free, (velocity - settings.margin) / rate_hz])
        weights = np.full(size, settings.acceleration)
        weights[:ROOT] = settings.root_acceleration
        self.links = (weights * rate_hz**2) ** 2

    def linearize(
        self, frames: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Own costs (F,), gradients (F, N) and Gauss-Newton matrices (F, N, N)."""
        count, size = states.shape
        costs, gradients = np.empty(count), np.empty((count, size))
        matrices = np.empty((count, size, size))
        linearized(self._tree, self._goal, frames, states, self._work, costs, gradients, matrices)
        return costs, gradients, matrices

    def cost(self, frames: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Own costs (F,)."""
        out = np.empty(len(frames))
        frame_costs(self._tree, self._goal, frames, np.ascontiguousarray(states), self._work, out)
        return out


def _tree(robot: Robot) -> _Tree:
    joints = robot.joint_of_link
    paths = [
        [0, 1, 2, *(3 + joints[link] for link in robot.path(end) if joints[link] >= 0)]
        for end in range(robot.num_links)
    ]
    return _Tree(
        parents=np.array(robot.parents),
        offsets=robot.offsets,
        turns=robot.turns,
        joint_of_link=joints,
        axes=robot.axes,
        anchors=robot.anchors,
        path_starts=np.cumsum([0, *map(len, paths)]),
        path_axes=np.array([axis for path in paths for axis in sorted(path)]),
    )
