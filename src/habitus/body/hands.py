"""Hands by name: a fist, a pinch, a flat hand, as rotations of finger joints.

The axes come from the skeleton at rest, not from its bones' frames, so that every body of SMPL-H's
family takes the same angles. A finger bends in the plane of its own direction and the normal of the
palm, the thumb towards the base of the little finger; fingers that fan out therefore meet at the
palm, as real ones do. Angles are those that a clinician measures: zero is a straight finger in the
plane of the palm, whatever the body's rest pose is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel
from habitus.errors import HabitusError

FINGERS = ("index", "middle", "ring", "pinky")
SIDES = ("left", "right")


@dataclass(frozen=True)
class HandPose:
    """Angles of one hand, degrees.

    ``index``, ``middle``, ``ring``, ``pinky``: flexion of a finger's three joints, from the palm on
    (MCP, PIP, DIP). ``thumb``: flexion of its three joints towards the base of the little finger
    (CMC, MCP, IP), and ``abduction`` of the first away from the palm. ``spread`` turns index,
    middle, ring and little finger in the plane of the palm, towards the thumb.
    """

    index: tuple[float, float, float] = (0.0, 0.0, 0.0)
    middle: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ring: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pinky: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thumb: tuple[float, float, float] = (0.0, 0.0, 0.0)
    abduction: float = 0.0
    spread: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


HAND_POSES: Mapping[str, HandPose] = MappingProxyType(
    {
        "flat": HandPose(),
        "relaxed": HandPose(
            (20, 25, 10), (25, 30, 12), (30, 32, 14), (32, 32, 14), (5, 10, 10), 10
        ),
        "fist": HandPose(
            (68, 88, 45), (71, 88, 45), (73, 88, 45), (75, 85, 45), (12, 32, 45), 36,
            (-4, 0, 4, 6),
        ),
        "grip": HandPose(
            (45, 55, 30), (48, 55, 30), (50, 55, 30), (52, 55, 30), (15, 20, 20), 40
        ),
        "pinch": HandPose(
            (55, 56, 36), (25, 30, 12), (25, 30, 12), (25, 30, 12), (-4, 23, 27), 32
        ),
    }
)  # fmt: skip
"""Named poses of a hand. A gripped cylinder is about 5 cm wide."""


def hand_pose(
    body: BodyModel,
    pose: str | HandPose,
    sides: tuple[str, ...] = SIDES,
    amount: float = 1.0,
) -> dict[str, Float[np.ndarray, "3"]]:
    """Rotation vectors (rad) of the finger joints for a pose of `HAND_POSES`, or one of your own,
    by their names: what ``body(betas, pose)`` and exports take.

    amount: 0 leaves the hands at rest, 1 is the pose. Raises HabitusError for a body without finger
    joints (``load_body("default", joints="smplh")`` has them) and for an unknown pose or side.
    """
    if isinstance(pose, str):
        if pose not in HAND_POSES:
            raise HabitusError(f"hand pose is {pose!r}; expected one of {', '.join(HAND_POSES)}")
        pose = HAND_POSES[pose]
    if strange := [side for side in sides if side not in SIDES]:
        raise HabitusError(f"side is {strange[0]!r}; expected left or right")
    rest = dict(zip(body.joint_names, np.asarray(body.rest_joints()), strict=True))
    needed = [f"{side}_{name}{k}" for side in sides for name in (*FINGERS, "thumb") for k in (1, 3)]
    if missing := [name for name in (*needed, *(f"{s}_wrist" for s in sides)) if name not in rest]:
        raise HabitusError(
            f"{body.name} has no joint {missing[0]!r}; expected a body with fingers, such as "
            'load_body("default", joints="smplh")'
        )
    rotations: dict[str, np.ndarray] = {}
    for side in sides:
        rotations |= {
            f"{side}_{joint}": amount * turn
            for joint, turn in _hand(body, rest, side, pose).items()
        }
    return rotations


def _hand(
    body: BodyModel, rest: Mapping[str, np.ndarray], side: str, pose: HandPose
) -> dict[str, np.ndarray]:
    """Rotation vectors of the joints of one hand."""
    palm = _palm(rest, side)
    rotations = {}
    for finger, spread in zip(FINGERS, pose.spread, strict=True):
        bones = _bones(body, rest, side, finger)
        along = _unit(bones[0] + bones[1])
        axis = _unit(np.cross(along, palm))
        flexion = np.radians(getattr(pose, finger)) - _rest_flexion(bones, axis, palm)
        thumbward = np.radians(spread) * (palm if side == "left" else -palm)
        turns = [Rotation.from_rotvec(angle * axis) for angle in flexion]
        turns[0] = Rotation.from_rotvec(thumbward) * turns[0]
        rotations |= {f"{finger}{k + 1}": turn.as_rotvec() for k, turn in enumerate(turns)}
    bones = _bones(body, rest, side, "thumb")
    across = rest[f"{side}_pinky1"] - rest[f"{side}_thumb2"]
    axis = _unit(np.cross(bones[1], across))
    away = _unit(np.cross(bones[0], palm))
    turns = [Rotation.from_rotvec(np.radians(angle) * axis) for angle in pose.thumb]
    turns[0] = Rotation.from_rotvec(np.radians(pose.abduction) * away) * turns[0]
    return rotations | {f"thumb{k + 1}": turn.as_rotvec() for k, turn in enumerate(turns)}


def _palm(rest: Mapping[str, np.ndarray], side: str) -> Float[np.ndarray, "3"]:
    """The normal of the palm, to where the fingers bend."""
    wrist, index, pinky = (rest[f"{side}_{name}"] for name in ("wrist", "index1", "pinky1"))
    along = 0.5 * (index + pinky) - wrist
    return _unit(np.cross(along, index - pinky)) * (1.0 if side == "left" else -1.0)


def _bones(
    body: BodyModel, rest: Mapping[str, np.ndarray], side: str, finger: str
) -> Float[np.ndarray, "3 3"]:
    """Directions of a finger's three bones at rest; the last one ends at its farthest vertex."""
    first, second, third = (rest[f"{side}_{finger}{k}"] for k in (1, 2, 3))
    weight = body.skinning_weights[:, body.joint_names.index(f"{side}_{finger}3")]
    skin = body.rest_vertices()[weight > 0.5]
    along = _unit(third - second)
    reach = (skin - third) @ along
    tip = skin[reach > reach.max() - 0.004].mean(axis=0)
    return np.array([_unit(second - first), along, _unit(tip - third)])


def _rest_flexion(
    bones: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, "3"], palm: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """How far the joints are bent at rest (rad): of the first bone from the plane of the palm, of
    the others from the bone before.
    """
    straight = np.cross(palm, axis)
    angles = np.arctan2(bones @ palm, bones @ straight)
    return np.diff(angles, prepend=0.0)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
