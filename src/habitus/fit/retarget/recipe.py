"""A motion carried over to another body (M 9.2), with feet that stand where they stood and nothing
below the ground.

M takes pose, soft tissue and place as they are. On legs of another length feet would then slide and
hang in the air or in the ground, so here the way of the root is scaled with the legs, feet are
moved to where they stood, and legs follow.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from habitus.body.measurements import Soles, find_soles
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.recentred import FROM
from habitus.errors import HabitusError
from habitus.fit.retarget.contacts import (
    ContactSettings,
    corrections,
    ground_height,
    standing,
)
from habitus.fit.retarget.legs import SOFT_KNEE, Leg, Skeleton, bones, legs_of, reach, skeleton_of
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix, up_rotation


@dataclass(frozen=True)
class RetargetSettings:
    """Settings of retargeting."""

    straight: float = 0.998
    """Share of its length to which a leg may be stretched where the source's was less: a straight
    knee pops."""
    smooth: float = 0.25
    """Seconds over which the root gives way to what legs and ground ask."""
    soft_knee: float = SOFT_KNEE
    """Radians: bend of a knee up to which it gives way to smoothness (`habitus.fit.retarget.legs`).
    """
    rounds: int = 2
    """Corrections of the feet: skin follows joints nearly, not exactly."""
    contacts: ContactSettings = field(default_factory=ContactSettings)


RETARGET = RetargetSettings()


@dataclass(frozen=True)
class Retargeting:
    """A motion on another body and how well it stands. ``scale``: of the way, as its legs are
    longer than the source's.

    Metres and seconds: ``standing`` s that some foot stands; ``slip`` m/s of the points that stand,
    of the source, of the same pose and scaled way without more ado (plain), and of the result;
    ``below``: the lowest point of each.
    """

    motion: BodyMotion
    scale: float
    standing: float
    slip: tuple[float, float, float]
    below: tuple[float, float, float]


def retargeted(
    source: BodyMotion,
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    name: str,
    settings: RetargetSettings = RETARGET,
) -> Retargeting:
    """The motion of ``source`` on ``body`` of shape ``betas``; soft tissue, rate and world are the
    source's.

    ``body`` has the source's joints and shape space. ``name`` says whose body it is. Raises
    HabitusError for bodies that differ in joints or have no legs and feet of SMPL's names.
    """
    _check(source.body, body)
    turn = up_rotation(source.up_axis)
    soles = find_soles(body, settings.contacts)
    before = turned(source, turn)
    there = before.points(soles.used)
    points = soles.means(there)
    still = standing(points, source.rate_hz, settings.contacts)
    ground = ground_height(points[..., 1], still, settings.contacts)
    plain, scale = _plain(before, body, betas, ground)
    lowest = lowest_heights(before)
    plain_lowest = lowest_heights(plain)
    targets = np.where([False, True, False], ground + scale * (points - ground), points)
    allowed = np.minimum(0.0, scale * (lowest - ground))
    moved = grounded(plain, soles, still, targets, ground + allowed, settings)
    slips = (
        _slip(before, soles, still),
        _slip(plain, soles, still),
        _slip(moved, soles, still),
    )
    below = (
        float((lowest - ground).min()),
        float((plain_lowest - ground).min()),
        float((lowest_heights(moved) - ground).min()),
    )
    note = (
        f"retargeted to {name}: way scaled by {scale:.3f}, feet kept where they stood, soft "
        "tissue carried over"
    )
    made = turned(moved, turn.T)
    pose = same_turns(made.pose, source.pose)
    whose = name if FROM in body.extras else source.body_name
    made = replace(
        made, pose=pose, up_axis=source.up_axis, body_name=whose, made=(*source.made, note)
    )
    seconds = float(still.any(axis=(1, 2)).sum() / source.rate_hz)
    return Retargeting(made, scale, seconds, slips, below)


def _check(body: BodyModel, other: BodyModel) -> None:
    if body.joint_names != other.joint_names or body.num_betas != other.num_betas:
        raise HabitusError(
            f"{other.name} has {other.num_joints} joints and {other.num_betas} betas; the "
            f"motion's body {body.name} has "
            f"{body.num_joints} and {body.num_betas}; expected another shape of the same body"
        )
    missing = [f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle")]
    missing = [name for name in missing if name not in other.joint_names]
    if missing:
        raise HabitusError(
            f"the body {other.name} has no joint {missing[0]}; expected legs under SMPL's names"
        )


def turned(motion: BodyMotion, turn: Float[np.ndarray, "3 3"]) -> BodyMotion:
    """The same motion in another world: the root turns about where it is."""
    root = skeleton_of(motion).rest[:, 0]
    pose = motion.pose.copy()
    pose[:, 0] = rotvec_from_matrix(turn @ matrix_from_rotvec(pose[:, 0]))
    return replace(motion, pose=pose, trans=(motion.trans + root) @ turn.T - root)


def same_turns(
    pose: Float[np.ndarray, "*batch 3"], other: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """The same rotations as vectors as near to ``other``'s as can be: turns that go on beyond half
    of one go on.
    """
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    around = pose * (1.0 - 2.0 * np.pi / np.maximum(angle, 1e-9))
    nearer = np.linalg.norm(around - other, axis=-1) < np.linalg.norm(pose - other, axis=-1)
    return np.where(nearer[..., None], around, pose)


def _plain(
    source: BodyMotion, body: BodyModel, betas: Float[np.ndarray, " B"], ground: float
) -> tuple[BodyMotion, float]:
    """The source's poses on the body, its root's way scaled about where it begins, heights about
    the ground.
    """
    legs = legs_of(body)
    still = replace(source, body=body, betas=betas)
    there = skeleton_of(source)
    here = skeleton_of(still)
    scale = _leg_length(still, legs) / _leg_length(source, legs)
    root = there.world[:, 0, :, 3]
    origin = np.array([root[0, 0], ground, root[0, 2]])
    way = origin + scale * (root - origin)
    return replace(still, trans=way - here.rest[:, 0]), scale


def _leg_length(motion: BodyMotion, legs: tuple[Leg, Leg]) -> float:
    """Thigh and shank, and the ankle's height above the sole, of both sides on average."""
    body = motion.body
    betas = motion.betas
    if motion.soft_tissue is not None:
        betas = betas + motion.soft_tissue.mean(axis=0)
    joints = body.rest_joints(betas)
    lowest = body.rest_vertices(betas)[:, 1].min()
    each = [
        np.linalg.norm(joints[leg.knee] - joints[leg.hip])
        + np.linalg.norm(joints[leg.ankle] - joints[leg.knee])
        + joints[leg.ankle, 1]
        - lowest
        for leg in legs
    ]
    return float(np.mean(each))


def grounded(
    plain: BodyMotion,
    soles: Soles,
    still: Bool[np.ndarray, "T 2 P"],
    targets: Float[np.ndarray, "T 2 P 3"],
    least: Float[np.ndarray, " T"],
    settings: RetargetSettings = RETARGET,
) -> BodyMotion:
    """The motion (y up) with feet at their targets while they stand, and nothing below ``least``.

    targets: as `habitus.fit.retarget.contacts.corrections` takes them.
    """
    moved = _standing(plain, soles, still, targets, least, settings)
    return _above(moved, plain, soles, still, targets, least, settings)


def _standing(
    plain: BodyMotion,
    soles: Soles,
    still: Bool[np.ndarray, "T 2 P"],
    targets: np.ndarray,
    least: np.ndarray,
    settings: RetargetSettings,
) -> BodyMotion:
    """The motion with feet at their places: the root gives way where legs are too short, then legs
    follow.

    ``least`` (T,): the height below which no foot goes.
    """
    legs = legs_of(plain.body)
    points = plain.points(soles.used)
    feet = soles.means(points)
    lows = soles.lowest(points)
    shifts = [corrections(feet[:, k], still[:, k], targets[:, k]) for k in range(2)]
    moved = plain
    for _ in range(settings.rounds):
        shifts = [_lifted(shift, low, least) for shift, low in zip(shifts, lows, strict=True)]
        moved = _with_feet(plain, legs, shifts, settings)
        missed = soles.means(moved.points(soles.used)) - feet - np.stack(shifts, 1)[:, :, None]
        shifts = [shift - missed[:, k].mean(axis=1) for k, shift in enumerate(shifts)]
    return moved


def _lifted(
    shift: np.ndarray, low: Float[np.ndarray, " T"], least: np.ndarray
) -> Float[np.ndarray, "T 3"]:
    out = shift.copy()
    out[:, 1] += np.maximum(least - (low + shift[:, 1]), 0.0)
    return out


def _with_feet(
    plain: BodyMotion,
    legs: tuple[Leg, Leg],
    shifts: list[np.ndarray],
    settings: RetargetSettings,
) -> BodyMotion:
    skeleton = skeleton_of(plain)
    goals = [
        skeleton.world[:, leg.ankle, :, 3] + shift for leg, shift in zip(legs, shifts, strict=True)
    ]
    trans = plain.trans.copy()
    trans[:, 1] -= _sunk(skeleton, legs, goals, plain.rate_hz, settings)
    pose = plain.pose
    lowered = replace(plain, trans=trans)
    skeleton = skeleton_of(lowered)
    for leg, goal in zip(legs, goals, strict=True):
        pose = reach(pose, skeleton, leg, goal, settings.soft_knee)
    return replace(lowered, pose=pose)


def _sunk(
    skeleton: Skeleton,
    legs: tuple[Leg, Leg],
    goals: list[np.ndarray],
    rate_hz: float,
    settings: RetargetSettings,
) -> Float[np.ndarray, " T"]:
    """How far the root sinks so that both legs reach their goals, smoothly."""
    needed = np.zeros(len(skeleton.rest))
    for leg, goal in zip(legs, goals, strict=True):
        length = sum(np.linalg.norm(bone, axis=1) for bone in bones(skeleton, leg))
        hip = skeleton.world[:, leg.hip, :, 3]
        ankle = skeleton.world[:, leg.ankle, :, 3]
        limit = np.maximum(settings.straight * length, np.linalg.norm(ankle - hip, axis=1))
        way = goal - hip
        across = np.minimum(np.hypot(way[:, 0], way[:, 2]), limit)
        needed = np.maximum(needed, -way[:, 1] - np.sqrt(limit**2 - across**2))
    return _above_smoothly(needed, settings.smooth * rate_hz)


def _above_smoothly(needed: Float[np.ndarray, " T"], frames: float) -> Float[np.ndarray, " T"]:
    """A smooth course that is nowhere below what is needed, nor below 0."""
    size = 2 * max(1, round(0.5 * frames)) + 1
    highest = maximum_filter1d(np.maximum(needed, 0.0), size, mode="nearest")
    return uniform_filter1d(highest, size, mode="nearest")


def _above(
    moved: BodyMotion,
    plain: BodyMotion,
    soles: Soles,
    still: Bool[np.ndarray, "T 2 P"],
    targets: np.ndarray,
    least: np.ndarray,
    settings: RetargetSettings,
) -> BodyMotion:
    """The motion with its root higher where hands, knees or a back would go below the ground.

    Feet stay where they stand as far as legs reach; then the whole body goes up.
    """
    frames = settings.smooth * moved.rate_hz
    lift = _above_smoothly(least - lowest_heights(moved), frames)
    if lift.any():
        moved = _standing(_raised(plain, lift), soles, still, targets, least, settings)
        moved = _raised(moved, _above_smoothly(least - lowest_heights(moved), frames))
    return moved


def _raised(motion: BodyMotion, lift: Float[np.ndarray, " T"]) -> BodyMotion:
    return replace(motion, trans=motion.trans + np.outer(lift, [0.0, 1.0, 0.0]))


def lowest_heights(motion: BodyMotion) -> Float[np.ndarray, " T"]:
    """The height of the lowest vertex of every frame."""
    parts = motion.surfaces(np.arange(motion.num_frames))
    return np.concatenate([part.vertices[..., 1].min(axis=-1) for part in parts])


def _slip(motion: BodyMotion, soles: Soles, still: Bool[np.ndarray, "T 2 P"]) -> float:
    """Root mean square speed (m/s) of points of the soles from one frame in which they stand to the
    next.
    """
    points = soles.means(motion.points(soles.used))
    both = still[1:] & still[:-1]
    way = np.linalg.norm(np.diff(points, axis=0), axis=-1)[both] * motion.rate_hz
    return float(np.sqrt(np.mean(way**2))) if both.any() else 0.0
