"""How well a robot follows a person: directions, feet, limits, clearance, and a verdict."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.robot import LinkPoses, Robot
from habitus.fit.retarget.robots import (
    RobotRetargeting,
    clear_pairs,
    floor_points,
    segment_distance,
)
from habitus.fit.verdict import (
    NOT_FINITE,
    Bound,
    Reason,
    Verdict,
    above,
    solver_reasons,
    verdict_of,
)

AT_LIMIT = 1e-3
"""Radians from a limit at which a joint is at it."""
FAR = np.deg2rad(15.0)
"""A segment farther from the person's than this is not reached."""
FAST = 0.98
"""Share of a limit of speed from which a joint is at it."""


@dataclass(frozen=True)
class RobotLimits:
    """Beyond the first number a result is doubtful, beyond the second it has failed."""

    direction: Bound = Bound(12.0, 25.0)
    """Degrees, mean of all segments' directions where no limit of a joint holds them."""
    segment: Bound = Bound(20.0, 60.0)
    """Degrees, mean of the worst segment."""
    slip: Bound = Bound(0.01, 0.1)
    """m/s, root mean square of points that stand."""
    penetration: Bound = Bound(0.01, 0.05)
    """Metres below the ground."""
    overlap: Bound = Bound(0.01, 0.04)
    """Metres by which two links enter one another."""
    speed: Bound = Bound(0.02, 0.2)
    """Share of frames in which some joint is as fast as it can be."""


LIMITS = RobotLimits()
SENTENCES = {
    "direction": "Segments are {value:.0f} degrees from the person's on average.",
    "segment": "The robot cannot follow the {name}: {value:.0f} degrees off on average.",
    "slip": "Feet that stand slip by {value:.0f} mm/s.",
    "palms": "Hands at rest on the ground slip by {value:.0f} mm/s.",
    "penetration": "The robot is {value:.0f} mm below the ground.",
    "overlap": "Links enter one another by {value:.0f} mm.",
    "speed": "In {value:.0f} % of the frames a joint is at its limit of speed.",
    NOT_FINITE: "The solver found no finite cost.",
    "no stand": "No foot of the person stands; the height of the ground is a guess.",
}


@dataclass(frozen=True, eq=False)
class RobotQuality:
    """Numbers of a robot's motion, SI units and degrees.

    ``directions`` (T) by segment are angles between the robot's and the person's directions, the
    largest of a segment's; ``free`` (T) by segment says where no joint that moves the segment is at
    a limit. ``slip`` (m/s) is the root mean square level speed of heels and toes that stand,
    ``standing`` (s) how long some do; ``penetration`` and ``overlap`` are the largest (m);
    ``at_limit`` and ``at_speed`` are shares of frames by joint; ``palm_slip`` (m/s) and ``resting``
    (s) are of hands on the ground.
    """

    directions: dict[str, Float[np.ndarray, " T"]]
    free: dict[str, Bool[np.ndarray, " T"]]
    slip: float
    standing: float
    penetration: float
    overlap: float
    at_limit: dict[str, float]
    at_speed: dict[str, float]
    palm_slip: float
    resting: float
    verdict: Verdict

    @property
    def mean_direction(self) -> float:
        """Degrees, mean over segments and frames."""
        return float(np.mean([angles.mean() for angles in self.directions.values()]))

    @property
    def mean_free_direction(self) -> float:
        """Degrees, mean over the frames in which no limit holds a segment; NaN without any."""
        some = [self.directions[name][self.free[name]] for name in self.directions]
        return float(np.mean(np.concatenate(some))) if any(map(len, some)) else float("nan")

    def unreached(self, name: str) -> float:
        """Share of frames in which a segment is more than 15 degrees from the person's."""
        return float(np.mean(self.directions[name] > np.rad2deg(FAR)))


def robot_quality(result: RobotRetargeting, limits: RobotLimits = LIMITS) -> RobotQuality:
    """Measure a robot's motion against the person's."""
    motion, robot = result.motion, result.motion.robot
    links = motion.links()
    at_limit = (motion.angles < robot.lower + AT_LIMIT) | (motion.angles > robot.upper - AT_LIMIT)
    velocity = np.where(np.isfinite(robot.velocity), robot.velocity, result.pairs.velocity)
    speeds = np.abs(np.diff(motion.angles, axis=0)) * motion.rate_hz
    fast = speeds > FAST * velocity
    directions, free = {}, {}
    for name, part in result.pairs.segments.items():
        link = robot.link(part.link)
        turns = links.rotations[:, link] @ robot.zero.rotations[link].T
        angles = [
            _angle((turns @ axis), result.person.directions[name, kind])
            for kind, axis in part.directions.items()
        ]
        directions[name] = np.rad2deg(np.max(angles, axis=0))
        joints = robot.joint_of_link[robot.path(link)]
        free[name] = ~at_limit[:, joints[joints >= 0]].any(axis=1)
    slip, standing = _slip(result, links)
    palm_slip, resting = _palm_slip(result, links)
    penetration = max(0.0, -float(lowest_heights(result, links).min()))
    overlap = float(overlaps(result, links).max())
    measured = RobotQuality(
        directions,
        free,
        slip,
        standing,
        penetration,
        overlap,
        dict(zip(robot.joint_names, at_limit.mean(axis=0).tolist(), strict=True)),
        dict(zip(robot.joint_names, _shares(fast), strict=True)),
        palm_slip,
        resting,
        Verdict("good", ()),
    )
    reasons = list(_reasons(result, measured, float(fast.any(axis=1).mean()), limits))
    return replace(measured, verdict=verdict_of(reasons, SENTENCES))


def _shares(flags: Bool[np.ndarray, "S n"]) -> list[float]:
    return (flags.mean(axis=0) if len(flags) else np.zeros(flags.shape[1])).tolist()


def _angle(
    first: Float[np.ndarray, "T 3"], second: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, " T"]:
    """Angles between unit vectors (rad)."""
    return 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(first - second, axis=1), 0.0, 1.0))


def _places(
    robot: Robot, links: LinkPoses, name: str, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "T n 3"]:
    """Points of a link (m from its origin at zero) in the world."""
    link = robot.link(name)
    local = points @ robot.zero.rotations[link]
    turned = np.einsum("tij,nj->tni", links.rotations[:, link], local)
    return turned + links.origins[:, None, link]


def _slip(result: RobotRetargeting, links: LinkPoses) -> tuple[float, float]:
    """Level speed of standing heels and toes (m/s, root mean square), seconds of any standing."""
    rate = result.motion.rate_hz
    squares, any_stands = [], np.zeros(result.motion.num_frames, bool)
    for sole, made in zip(result.pairs.soles, result.prints, strict=True):
        first = len(sole.heel)
        ends = np.stack([sole.heel.mean(axis=0), sole.toes.mean(axis=0)])
        places = _places(result.motion.robot, links, sole.link, ends)[..., :2]
        for k, rows in enumerate((slice(0, first), slice(first, None))):
            stands = np.asarray(made.stands[:, rows].any(axis=1))
            any_stands |= stands
            way = np.linalg.norm(np.diff(places[:, k], axis=0), axis=1)
            squares.append((way[stands[1:] & stands[:-1]] * rate) ** 2)
    squared = np.concatenate(squares)
    return float(np.sqrt(squared.mean())) if len(squared) else 0.0, any_stands.sum() / rate


def _palm_slip(result: RobotRetargeting, links: LinkPoses) -> tuple[float, float]:
    """Horizontal speed of hands at rest on the ground (m/s, root mean square), and how long (s) any
    rests; zeros for a robot whose table has no capsules for hands.
    """
    rate = result.motion.rate_hz
    squares, any_rest = [np.zeros(0)], np.zeros(result.motion.num_frames, bool)
    for k, side in enumerate(("left", "right")):
        part = result.pairs.capsules.get(f"{side}_hand")
        if part is None:
            continue
        resting = result.person.resting[:, k]
        middle = part.ends.mean(axis=0, keepdims=True)
        places = _places(result.motion.robot, links, part.link, middle)[:, 0, :2]
        way = np.linalg.norm(np.diff(places, axis=0), axis=1)
        squares.append((way[resting[1:] & resting[:-1]] * rate) ** 2)
        any_rest |= resting
    squared = np.concatenate(squares)
    return float(np.sqrt(squared.mean())) if len(squared) else 0.0, float(any_rest.sum() / rate)


def lowest_heights(result: RobotRetargeting, links: LinkPoses) -> Float[np.ndarray, " T"]:
    """Height (m) of the lowest point of soles and capsules, in each frame."""
    robot = result.motion.robot
    heights = [
        _places(robot, links, robot.link_names[link], place[None])[:, 0, 2] - radius
        for link, place, radius in floor_points(robot, result.pairs)
    ]
    return np.min(heights, axis=0)


def overlaps(result: RobotRetargeting, links: LinkPoses) -> Float[np.ndarray, " T"]:
    """The deepest overlap (m) of two capsules that are to keep clear, in each frame."""
    robot = result.motion.robot
    capsules = list(result.pairs.capsules.values())
    ends = [_places(robot, links, part.link, part.ends) for part in capsules]
    depth = np.zeros(result.motion.num_frames)
    for a, b in clear_pairs(robot, result.pairs):
        reach = capsules[a].radius + capsules[b].radius
        depth = np.maximum(depth, reach - segment_distance(ends[a], ends[b]))
    return depth


def _reasons(
    result: RobotRetargeting, quality: RobotQuality, at_speed: float, limits: RobotLimits
) -> list[Reason]:
    out = [*solver_reasons(result.status)]
    if not quality.standing:
        out.append(Reason("doubtful", "no stand"))
    worst = max(quality.directions, key=lambda name: quality.directions[name].mean())
    for key, value, bound, scale in (
        ("direction", quality.mean_free_direction, limits.direction, 1.0),
        ("segment", float(quality.directions[worst].mean()), limits.segment, 1.0),
        ("slip", quality.slip, limits.slip, 1e3),
        ("palms", quality.palm_slip, limits.slip, 1e3),
        ("penetration", quality.penetration, limits.penetration, 1e3),
        ("overlap", quality.overlap, limits.overlap, 1e3),
        ("speed", at_speed, limits.speed, 100.0),
    ):
        level = above(value, bound)
        if level != "good":
            name = worst.replace("_", " ")
            out.append(Reason(level, key, {"value": scale * value, "name": name}))
    return out
