"""How well a robot follows a person: directions, feet, limits, clearance, and a verdict."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.fit.retarget.robots import RobotRetargeting, clear_pairs, segment_distance
from habitus.fit.verdict import Bound, Reason, Verdict, above, verdict_of

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
    "penetration": "The robot is {value:.0f} mm below the ground.",
    "overlap": "Links enter one another by {value:.0f} mm.",
    "speed": "In {value:.0f} % of the frames a joint is at its limit of speed.",
    "not finite": "The solver found no finite cost.",
    "no stand": "No foot of the person stands; the height of the ground is a guess.",
}


@dataclass(frozen=True, eq=False)
class RobotQuality:
    """Numbers of a robot's motion, SI units and degrees.

    ``directions`` (T) by segment are angles between the robot's and the person's directions, the
    largest of a segment's; ``free`` (T) by segment says where no joint that moves the segment is at
    a limit. ``slip`` (m/s) is the root mean square level speed of heels and toes that stand,
    ``standing`` (s) how long some do; ``penetration`` and ``overlap`` are the largest (m);
    ``at_limit`` and ``at_speed`` are shares of frames by joint.
    """

    directions: dict[str, Float[np.ndarray, " T"]]
    free: dict[str, Bool[np.ndarray, " T"]]
    slip: float
    standing: float
    penetration: float
    overlap: float
    at_limit: dict[str, float]
    at_speed: dict[str, float]
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
    slip, standing = _slip(result, links.rotations, links.origins)
    penetration = max(0.0, -float(_lowest(result, links.rotations, links.origins).min()))
    overlap = float(overlaps(result).max())
    measured = RobotQuality(
        directions,
        free,
        slip,
        standing,
        penetration,
        overlap,
        dict(zip(robot.joint_names, at_limit.mean(axis=0).tolist(), strict=True)),
        dict(zip(robot.joint_names, _shares(fast), strict=True)),
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


def _slip(result: RobotRetargeting, turns: np.ndarray, origins: np.ndarray) -> tuple[float, float]:
    """Level speed of standing heels and toes (m/s, root mean square), seconds of any standing."""
    robot, rate = result.motion.robot, result.motion.rate_hz
    squares, any_stands = [], np.zeros(len(turns), bool)
    for sole, made in zip(result.pairs.soles, result.prints, strict=True):
        link = robot.link(sole.link)
        first = len(sole.heel)
        for points, rows in ((sole.heel, slice(0, first)), (sole.toes, slice(first, None))):
            local = points.mean(axis=0) @ robot.zero.rotations[link]
            place = (turns[:, link] @ local + origins[:, link])[:, :2]
            stands = np.asarray(made.stands[:, rows].any(axis=1))
            any_stands |= stands
            way = np.linalg.norm(np.diff(place, axis=0), axis=1)[stands[1:] & stands[:-1]]
            squares.append((way * rate) ** 2)
    squared = np.concatenate(squares)
    return float(np.sqrt(squared.mean())) if len(squared) else 0.0, any_stands.sum() / rate


def _lowest(
    result: RobotRetargeting, turns: np.ndarray, origins: np.ndarray
) -> Float[np.ndarray, " T"]:
    """Height of the lowest point of soles and capsules (m)."""
    robot = result.motion.robot
    soled = {sole.link for sole in result.pairs.soles}
    heights = []
    for sole in result.pairs.soles:
        link = robot.link(sole.link)
        local = np.concatenate([sole.heel, sole.toes]) @ robot.zero.rotations[link]
        heights.append(np.einsum("tj,nj->nt", turns[:, link, 2], local) + origins[:, link, 2])
    for part in result.pairs.capsules.values():
        if part.link not in soled:
            link = robot.link(part.link)
            local = part.ends @ robot.zero.rotations[link]
            height = np.einsum("tj,nj->nt", turns[:, link, 2], local) + origins[:, link, 2]
            heights.append(height - part.radius)
    return np.concatenate(heights).min(axis=0)


def overlaps(result: RobotRetargeting) -> Float[np.ndarray, " T"]:
    """The deepest overlap (m) of two capsules that are to keep clear, in each frame."""
    turns, origins = result.motion.links()
    robot = result.motion.robot
    capsules = list(result.pairs.capsules.values())
    ends = []
    for part in capsules:
        link = robot.link(part.link)
        local = part.ends @ robot.zero.rotations[link]
        ends.append(np.einsum("tij,nj->tni", turns[:, link], local) + origins[:, None, link])
    depth = np.zeros(result.motion.num_frames)
    for a, b in clear_pairs(robot, result.pairs):
        reach = capsules[a].radius + capsules[b].radius
        depth = np.maximum(depth, reach - segment_distance(ends[a], ends[b]))
    return depth


def _reasons(
    result: RobotRetargeting, quality: RobotQuality, at_speed: float, limits: RobotLimits
) -> list[Reason]:
    out = []
    if result.status == "not finite":
        out.append(Reason("failed", result.status))
    if not quality.standing:
        out.append(Reason("doubtful", "no stand"))
    worst = max(quality.directions, key=lambda name: quality.directions[name].mean())
    for key, value, bound, scale in (
        ("direction", quality.mean_free_direction, limits.direction, 1.0),
        ("segment", float(quality.directions[worst].mean()), limits.segment, 1.0),
        ("slip", quality.slip, limits.slip, 1e3),
        ("penetration", quality.penetration, limits.penetration, 1e3),
        ("overlap", quality.overlap, limits.overlap, 1e3),
        ("speed", at_speed, limits.speed, 100.0),
    ):
        level = above(value, bound)
        if level != "good":
            name = worst.replace("_", " ")
            out.append(Reason(level, key, {"value": scale * value, "name": name}))
    return out
