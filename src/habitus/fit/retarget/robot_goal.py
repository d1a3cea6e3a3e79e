"""What a robot shall do in every frame, by a body's motion: directions of its links, where its feet
stand, where its hips are.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.arrays import runs
from habitus.body.measurements import find_soles
from habitus.body.motion import BodyMotion
from habitus.body.robot import TO_ROBOT, Robot
from habitus.fit.retarget.contacts import (
    ContactSettings,
    bridged,
    ground_height,
    standing,
    stands,
)
from habitus.fit.retarget.legs import Skeleton, skeleton_of
from habitus.fit.retarget.robot_pairs import BODY_AXES, PALM, SEGMENTS, RobotPairs, Sole
from habitus.rotations import up_rotation


class Person(NamedTuple):
    """A body's motion in a robot's world: z up from the ground, metres, T frames.

    ``directions`` (T, 3) by segment and name; ``hips`` (T, 3) between the hip joints; ``soles``
    (T, 2, 3, 3): side; heel, ball, toes; ``still`` says which of them stand; ``frames`` are the
    segments' rotations from the axes of the robot at rest. ``palms`` (T, 2, 3) are middles of the
    hands, ``resting`` (T, 2) says when they are at rest on the ground. ``leg`` is the height (m) of
    the hip joints of the body standing, ``ground`` that of the ground in the capture's world.
    """

    directions: dict[tuple[str, str], Float[np.ndarray, "T 3"]]
    frames: dict[str, Float[np.ndarray, "T 3 3"]]
    hips: Float[np.ndarray, "T 3"]
    soles: Float[np.ndarray, "T 2 3 3"]
    still: Bool[np.ndarray, "T 2 3"]
    palms: Float[np.ndarray, "T 2 3"]
    resting: Bool[np.ndarray, "T 2"]
    leg: float
    ground: float


def person_of(motion: BodyMotion, pairs: RobotPairs, contacts: ContactSettings) -> Person:
    """What of a body's motion a robot can follow. Raises HabitusError for a body without SMPL's
    joints in legs and arms.
    """
    turn = TO_ROBOT @ up_rotation(motion.up_axis)
    skeleton = skeleton_of(motion)
    names = list(motion.body.joint_names)
    soles = find_soles(motion.body, contacts)
    points = soles.means(motion.points(soles.used)) @ turn.T
    still = standing(points, motion.rate_hz, contacts)
    ground = np.array([0.0, 0.0, ground_height(points[..., 2], still, contacts)])
    hips = [names.index(f"{side}_hip") for side in ("left", "right")]
    rest = motion.body.rest_vertices(motion.betas)
    palms, resting = _palms(skeleton.world[..., 3] @ turn.T - ground, names, motion, contacts)
    return Person(
        directions=_directions(skeleton, names, pairs, turn),
        frames={
            name: turn @ skeleton.world[:, names.index(SEGMENTS[name][0]), :, :3] @ TO_ROBOT.T
            for name in pairs.segments
        },
        hips=skeleton.world[..., 3][:, hips].mean(axis=1) @ turn.T - ground,
        soles=points - ground,
        still=still,
        palms=palms,
        resting=resting,
        leg=float(skeleton.rest[:, hips, 1].mean() - rest[:, 1].min()),
        ground=float(ground[2]),
    )


def _palms(
    joints: Float[np.ndarray, "T J 3"],
    names: list[str],
    motion: BodyMotion,
    contacts: ContactSettings,
) -> tuple[Float[np.ndarray, "T 2 3"], Bool[np.ndarray, "T 2"]]:
    """Middles of both hands (m), and the frames in which they rest on the ground: none for a body
    without hands.
    """
    palms = np.zeros((len(joints), 2, 3))
    for k, side in enumerate(("left", "right")):
        ends = [f"{side}_{name}" for name in ("hand", "middle1") if f"{side}_{name}" in names]
        if f"{side}_wrist" not in names or not ends:
            return palms, np.zeros(palms.shape[:2], bool)
        both = [names.index(f"{side}_wrist"), names.index(ends[0])]
        palms[:, k] = joints[:, both].mean(axis=1)
    low = palms[..., 2] < PALM_HEIGHT
    return palms, low & standing(palms, motion.rate_hz, contacts)


def _directions(
    skeleton: Skeleton, names: list[str], pairs: RobotPairs, turn: Float[np.ndarray, "3 3"]
) -> dict[tuple[str, str], Float[np.ndarray, "T 3"]]:
    """Directions of segments in the world, one for each that the table names."""
    out = {}
    for segment, paired in pairs.segments.items():
        joint, end = SEGMENTS[segment]
        world = turn @ skeleton.world[:, names.index(joint), :, :3]
        for kind in paired.directions:
            if kind == "along" and end is not None:
                rest = skeleton.rest[:, names.index(end)] - skeleton.rest[:, names.index(joint)]
                rest = rest * (1.0, 0.0, 1.0) if segment.endswith("_foot") else rest
            else:
                rest = np.array(PALM if kind == "palm" else BODY_AXES[kind])[None]
            way = (world @ (rest / np.linalg.norm(rest, axis=1, keepdims=True))[..., None])[..., 0]
            out[segment, kind] = way
    return out


def leg_of(robot: Robot, pairs: RobotPairs) -> tuple[float, Float[np.ndarray, " 3"]]:
    """Height of a robot's hips over its soles with straight legs, and where they are from the
    origin of its pelvis link, with all joints at zero.
    """
    pelvis = robot.link(pairs.segments["pelvis"].link)
    hips, lows = [], []
    for side, sole in zip(("left", "right"), pairs.soles, strict=True):
        path = robot.path(robot.link(pairs.segments[f"{side}_thigh"].link))
        above = path.index(pelvis) if pelvis in path else len(path) - 1
        hips.append(robot.zero.origins[path[max(above - 1, 0)]])
        foot = robot.zero.origins[robot.link(sole.link)]
        lows.append((foot + np.concatenate([sole.heel, sole.toes]))[:, 2].mean())
    between = np.mean(hips, axis=0)
    return float(between[2] - np.mean(lows)), between - robot.zero.origins[pelvis]


@dataclass(frozen=True)
class Footprints:
    """Where a robot's soles shall be: ``targets`` (T, n, 3) of its points, which of them stand, and
    the way of their middle in every frame (T, 3).
    """

    targets: Float[np.ndarray, "T n 3"]
    stands: Bool[np.ndarray, "T n"]
    middle: Float[np.ndarray, "T 3"]


def footprints(
    points: Float[np.ndarray, "T 3 3"],
    still: Bool[np.ndarray, "T 3"],
    sole: Sole,
    scale: float,
    origin: Float[np.ndarray, " 3"],
) -> Footprints:
    """Footprints of a robot's foot, by a body's heel, ball and toes and when each stands.

    As long as a foot stands its print stays in one place, with the foot's middle where the body's
    is, scaled about ``origin``. A foot that turns by more than 10 degrees meanwhile turns about its
    heel or its toes, whichever stand longer. Prints are level; one up to 4 cm above the ground lies
    on it.
    """
    heel, toes = points[:, 0], points[:, 2]
    middle = origin + scale * (0.5 * (heel + toes) - origin)
    heading = np.unwrap(np.arctan2(*(toes - heel)[:, [1, 0]].T))
    local = np.concatenate([sole.heel, sole.toes]) - sole.middle
    is_heel = np.arange(len(local)) < len(sole.heel)
    parts = np.stack([still[:, 0], still[:, 1] | still[:, 2]], axis=1)
    out = Footprints(
        np.zeros((len(points), len(local), 3)), np.zeros((len(points), len(local)), bool), middle
    )
    shift = np.zeros((len(points), 3))

    def place(frames: Int[np.ndarray, " F"]) -> Float[np.ndarray, " 3"]:
        low = points[frames][:, :, 2].min()
        mean = middle[frames].mean(axis=0)
        return np.array([mean[0], mean[1], scale * low if low > STEP else 0.0])

    for first, end in runs(np.any(parts, axis=1)):
        frames = np.arange(first, end)
        flat = frames[parts[frames].all(axis=1)]
        level = flat if len(flat) else frames
        if np.ptp(heading[level]) < TURNS:
            print_ = place(level) + _level(local, heading[level].mean())
            out.targets[frames] = print_
            out.stands[frames] = np.where(is_heel, parts[frames, :1], parts[frames, 1:])
            shift[frames] = print_.mean(axis=0) - middle[frames]
            continue
        print_, active = _pivoting(local, is_heel, heading[frames], parts[frames])
        print_ += place(frames) - print_.mean(axis=(0, 1))
        out.targets[frames] = print_
        out.stands[frames] = is_heel == (active == 0)[:, None]
        shift[frames] = print_.mean(axis=1) - middle[frames]
    return replace(out, middle=middle + bridged(shift, np.any(out.stands, axis=1)))


def _pivoting(
    local: Float[np.ndarray, "n 3"],
    is_heel: Bool[np.ndarray, " n"],
    heading: Float[np.ndarray, " F"],
    parts: Bool[np.ndarray, "F 2"],
) -> tuple[Float[np.ndarray, "F n 3"], Int[np.ndarray, " F"]]:
    """Prints of a foot that turns about its heel or its toes, and about which (0, 1) in each frame.

    It turns about one as long as that stands, then about the other from where it is by then.
    """
    pivots = np.stack([local[is_heel].mean(axis=0), local[~is_heel].mean(axis=0)])
    (stand,) = stands(parts)
    place = np.zeros(3)
    prints = np.empty((len(parts), *local.shape))
    for t, now in enumerate(stand.active):
        before = stand.active[max(t - 1, 0)]
        place = place + _level(pivots[now] - pivots[before], heading[t])
        prints[t] = place + _level(local - pivots[now], heading[t])
    return prints, stand.active


PALM_HEIGHT = 0.1
"""Height (m) of the middle of a hand below which a still hand rests on the ground."""


def palm_prints(
    palm: Float[np.ndarray, "T 3"],
    resting: Bool[np.ndarray, " T"],
    scale: float,
    origin: Float[np.ndarray, " 3"],
    height: float,
) -> Float[np.ndarray, "T 3"]:
    """Targets (m) of the middle of a hand: in each run of ``resting`` frames one point, the mean of
    its path scaled about ``origin``, at ``height``.
    """
    out = origin + scale * (palm - origin)
    for first, end in runs(resting):
        out[first:end] = out[first:end].mean(axis=0)
    out[:, 2] = height
    return out


STEP = 0.04
"""Metres over the ground up to which a foot that stands stands on the ground."""
TURNS = np.deg2rad(10.0)


def _level(places: Float[np.ndarray, "*n 3"], angle: float) -> Float[np.ndarray, "*n 3"]:
    """Places of a sole turned by an angle about the vertical, their heights left out."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = places[..., 0], places[..., 1]
    return np.stack([c * x - s * y, s * x + c * y, np.zeros_like(x)], axis=-1)
