"""Hands by name: a fist, a pinch, a flat hand, as rotations of finger joints.

The axes come from the skeleton at rest, not from its bones' frames, so that every body of SMPL-H's
family takes the same angles. A finger bends in the plane of its own direction and the normal of the
palm, the thumb towards the base of the little finger; fingers that fan out therefore meet at the
palm, as real ones do. Angles are those that a clinician measures: zero is a straight finger in the
plane of the palm, whatever the body's rest pose is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.arrays import constant, flatten
from habitus.errors import HabitusError
from habitus.types import Array

FINGERS = ("index", "middle", "ring", "pinky")
SIDES = ("left", "right")
HAND_JOINTS = tuple(f"{finger}{k}" for finger in (*FINGERS, "thumb") for k in (1, 2, 3))
"""Joints of a hand, without its side, in the order of `HandAxes.rotations`."""
NUM_ANGLES = 20


class FingeredBody(Protocol):
    """What hands need of a body model."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def joint_names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def skinning_weights(self) -> Any: ...  # noqa: D102
    def rest_joints(self) -> Any: ...  # noqa: D102
    def rest_vertices(self) -> Any: ...  # noqa: D102


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

    @property
    def angles(self) -> Float[np.ndarray, "20"]:
        """All of them in one row, degrees: index, middle, ring, pinky, thumb, abduction, spread."""
        fingers = (self.index, self.middle, self.ring, self.pinky, self.thumb)
        row = [angle for finger in fingers for angle in finger]
        return np.array([*row, self.abduction, *self.spread], dtype=float)

    @staticmethod
    def of(angles: Sequence[float] | Float[np.ndarray, "20"]) -> "HandPose":
        """The pose of a row of `angles`."""
        row = tuple(float(angle) for angle in angles)
        return HandPose(row[:3], row[3:6], row[6:9], row[9:12], row[12:15], row[15], row[16:])  # pyright: ignore[reportArgumentType]


HAND_POSES: Mapping[str, HandPose] = MappingProxyType(
    {
        "flat": HandPose(),
        "relaxed": HandPose(
            (20, 25, 10), (25, 30, 12), (30, 32, 14), (32, 32, 14), (5, 10, 10), 10
        ),
        "fist": HandPose(
            (57, 67, 60), (57, 65, 42), (55, 82, 54), (69, 71, 53), (6, 16, 24), 18,
            (-4, 0, 4, 6),
        ),
        "grip": HandPose(
            (45, 55, 30), (48, 55, 30), (50, 55, 30), (52, 55, 30), (8, 16, 21), 32
        ),
        "pinch": HandPose(
            (55, 56, 36), (25, 30, 12), (25, 30, 12), (25, 30, 12), (-4, 23, 27), 32
        ),
    }
)  # fmt: skip
"""Named poses of a hand. A gripped cylinder is about 5 cm wide. The fist is as tight as skinned
fingers close without skin through skin: each joint bends up to the fold of its own crease, tips
come near the palm, the thumb lies before index and middle finger. A real fist bends a finger by
some 60 degrees more over its three joints.
"""


def hand_pose(
    body: FingeredBody,
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
    angles = np.radians(pose.angles)
    rotations: dict[str, np.ndarray] = {}
    for side in sides:
        turns = amount * HandAxes.of(body, side).rotations(angles)
        rotations |= {
            f"{side}_{joint}": turn for joint, turn in zip(HAND_JOINTS, turns, strict=True)
        }
    return rotations


@dataclass(frozen=True)
class HandAxes:
    """Axes of one hand's angles at rest, unit vectors in body space, and how far its fingers are
    bent there.

    flexion: of the joints of index, middle, ring, pinky and thumb. spread: of each finger towards
    the thumb; the thumb's is its abduction. rest (5, 3): flexion at rest, rad, 0 for the thumb.
    """

    flexion: Float[np.ndarray, "5 3"]
    spread: Float[np.ndarray, "5 3"]
    rest: Float[np.ndarray, "5 3"]

    @staticmethod
    def of(body: FingeredBody, side: str) -> "HandAxes":
        """The axes of a body's left or right hand. Raises HabitusError for a body without finger
        joints.
        """
        at = dict(zip(body.joint_names, np.asarray(body.rest_joints()), strict=True))
        needed = [f"{side}_{name}" for name in ("wrist", *HAND_JOINTS)]
        if missing := [name for name in needed if name not in at]:
            raise HabitusError(
                f"{body.name} has no joint {missing[0]!r}; expected a body with fingers, such as "
                'load_body("default", joints="smplh")'
            )
        vertices = np.asarray(body.rest_vertices())
        palm = _palm(at, side)
        axes, rest = [], []
        for finger in FINGERS:
            bones = _bones(body, vertices, at, f"{side}_{finger}")
            axes.append(_unit(np.cross(_unit(bones[0] + bones[1]), palm)))
            rest.append(_rest_flexion(bones, axes[-1], palm))
        thumb = _bones(body, vertices, at, f"{side}_thumb")
        across = at[f"{side}_pinky1"] - at[f"{side}_thumb2"]
        thumbward = palm if side == "left" else -palm
        return HandAxes(
            np.array([*axes, _unit(np.cross(thumb[1], across))]),
            np.array([*[thumbward] * len(FINGERS), _unit(np.cross(thumb[0], palm))]),
            np.array([*rest, np.zeros(3)]),
        )

    def rotations(self, angles: Float[np.ndarray, "*batch 20"]) -> Float[np.ndarray, "*batch 15 3"]:
        """Rotation vectors (rad) of `HAND_JOINTS` for rows of `HandPose.angles` in rad."""
        batch = angles.shape[:-1]
        bend = angles[..., :15].reshape(*batch, 5, 3) - self.rest
        aside = np.concatenate([angles[..., 16:], angles[..., 15:16]], axis=-1)
        turns = bend[..., None] * self.flexion[:, None]
        first = Rotation.from_rotvec((aside[..., None] * self.spread).reshape(-1, 3))
        first = first * Rotation.from_rotvec(turns[..., 0, :].reshape(-1, 3))
        turns[..., 0, :] = first.as_rotvec().reshape(*batch, 5, 3)
        return turns.reshape(*batch, 15, 3)

    def angles(self, rotations: Array) -> Array:
        """Rows of `HandPose.angles` (*batch, 20), rad, of rotation vectors (*batch, 15, 3), arrays
        or tensors: their parts along the axes, which for fingers spread by s and bent by f are s
        (1 - f^2 / 12) and f to second order. What turns a joint beside its axes is left out.
        """
        return flatten(rotations, -2) @ constant(self._along.T, rotations) + constant(
            self._offset, rotations
        )

    @property
    def _along(self) -> Float[np.ndarray, "20 45"]:
        """The axes as rows over the rotation vectors of a hand."""
        along = np.zeros((NUM_ANGLES, 5, 3, 3))
        for finger in range(5):
            for joint in range(3):
                along[3 * finger + joint, finger, joint] = self.flexion[finger]
            along[15 + (finger + 1) % 5, finger, 0] = self.spread[finger]
        return along.reshape(NUM_ANGLES, -1)

    @property
    def _offset(self) -> Float[np.ndarray, "20"]:
        return np.concatenate([self.rest.ravel(), np.zeros(5)])


def _palm(rest: Mapping[str, np.ndarray], side: str) -> Float[np.ndarray, "3"]:
    """The normal of the palm, to where the fingers bend."""
    wrist, index, pinky = (rest[f"{side}_{name}"] for name in ("wrist", "index1", "pinky1"))
    along = 0.5 * (index + pinky) - wrist
    return _unit(np.cross(along, index - pinky)) * (1.0 if side == "left" else -1.0)


def _bones(
    body: FingeredBody,
    vertices: Float[np.ndarray, "V 3"],
    rest: Mapping[str, np.ndarray],
    finger: str,
) -> Float[np.ndarray, "3 3"]:
    """Directions of a finger's three bones at rest; the last one ends at its farthest vertices,
    without any it goes on as the one before.
    """
    first, second, third = (rest[f"{finger}{k}"] for k in (1, 2, 3))
    weight = np.asarray(body.skinning_weights)[:, body.joint_names.index(f"{finger}3")]
    skin = vertices[weight > 0.5]
    along = _unit(third - second)
    if not len(skin):
        return np.array([_unit(second - first), along, along])
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
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
