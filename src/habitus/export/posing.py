"""A body's pose as other programs take it, frame by frame: VMC for avatars, and plain OSC messages
of its joints.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from habitus.export.osc import Bundles, Message
from habitus.rotations import (
    quaternion_from_matrix,
    quaternion_from_rotvec,
    quaternion_multiply,
    up_rotation,
)

VMC_PORT = 39539
OSC_PORT = 9000
_SIDES = {"left": "Left", "right": "Right"}
_MIDDLE = {
    "pelvis": "Hips",
    "spine1": "Spine",
    "spine2": "Chest",
    "spine3": "UpperChest",
    "neck": "Neck",
    "head": "Head",
    "jaw": "Jaw",
}
_PAIRED = {
    "hip": "UpperLeg",
    "knee": "LowerLeg",
    "ankle": "Foot",
    "foot": "Toes",
    "collar": "Shoulder",
    "shoulder": "UpperArm",
    "elbow": "LowerArm",
    "wrist": "Hand",
    "eye_smplhf": "Eye",
}
_FINGERS = {
    "thumb": "Thumb",
    "index": "Index",
    "middle": "Middle",
    "ring": "Ring",
    "pinky": "Little",
}
_PHALANGES = ("Proximal", "Intermediate", "Distal")
UNITY_BONES: Mapping[str, str] = {
    **_MIDDLE,
    **{
        f"{side}_{joint}": f"{Side}{bone}"
        for side, Side in _SIDES.items()
        for joint, bone in _PAIRED.items()
    },
    **{
        f"{side}_{finger}{k}": f"{Side}{Finger}{bone}"
        for side, Side in _SIDES.items()
        for finger, Finger in _FINGERS.items()
        for k, bone in enumerate(_PHALANGES, 1)
    },
}
"""Joints of the SMPL family by the names that Unity's humanoids have (``HumanBodyBones``), which
VMC and VRM use.
"""


class VmcPoses:
    """Poses as VMC messages (protocol.vmc.info): bones' places and turns against their parents, in
    Unity's space.

    Unity's space is left-handed: y up, facing +z, x to the body's right, so that a capture is
    turned to y up and x negated. Turns are those from the T-pose, in which a normalised avatar (VRM
    0) has none. joint_names, parents, joints (J, 3): of the person at rest, metres.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        parents: Sequence[int],
        joints: Float[np.ndarray, "J 3"],
        up_axis: str,
    ):
        self._turn = up_rotation(up_axis)
        self._rest = np.asarray(joints, dtype=np.float64)
        self._bones = [k for k, name in enumerate(joint_names) if name in UNITY_BONES]
        offsets = np.array([self._rest[k] - self._rest[parents[k]] for k in self._bones])
        self._places, self._upright = _mirrored(offsets), quaternion_from_matrix(self._turn)
        messages = [
            Message("/VMC/Ext/OK", "iiii"),
            Message("/VMC/Ext/T", "f"),
            Message("/VMC/Ext/Root/Pos", "sfffffff", ("root",)),
            *(
                Message("/VMC/Ext/Bone/Pos", "sfffffff", (UNITY_BONES[joint_names[k]],))
                for k in self._bones
            ),
        ]
        self._bundles = Bundles(messages)
        self._silent = Bundles(messages[:2])

    def packets(
        self,
        number: int,
        seconds: float,
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
        state: int,
    ) -> list[bytes]:
        """The datagrams of a frame. state: 1 followed, 0 carried on, -1 nobody, of whom no bones
        are told.
        """
        flags = (1, 3, 0, int(state > 0))  # loaded, calibrated, in normal mode, tracked
        if state < 0:
            return self._silent.filled([seconds], flags)
        turns = quaternion_from_rotvec(pose[self._bones])
        turns[0] = quaternion_multiply(self._upright, turns[0])
        quaternions = _xyzw(turns) * np.array([1.0, -1.0, -1.0, 1.0])
        places = self._places.copy()
        places[0] = _mirrored(self._turn @ (self._rest[self._bones[0]] + trans))
        bones = np.concatenate([places, quaternions], axis=1)
        return self._bundles.filled(
            np.concatenate([[seconds, 0, 0, 0, 0, 0, 0, 1], bones.ravel()]), flags
        )


class OscPoses:
    """Poses as messages of this project's own, in the body's axes and the capture's world
    (docs/live.md tells them).
    """

    def __init__(self, joint_names: Sequence[str]):
        self._bundles = Bundles(
            [
                Message("/habitus/frame", "iif"),
                Message("/habitus/trans", "fff"),
                *(Message("/habitus/joint", "sffff", (name,)) for name in joint_names),
            ]
        )
        self._silent = Bundles([Message("/habitus/frame", "iif")])

    def packets(
        self,
        number: int,
        seconds: float,
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
        state: int,
    ) -> list[bytes]:
        """The datagrams of a frame; state as for `VmcPoses`."""
        if state < 0:
            return self._silent.filled([seconds], (number, state))
        values = np.concatenate([[seconds], trans, _xyzw(quaternion_from_rotvec(pose)).ravel()])
        return self._bundles.filled(values, (number, state))


def _mirrored(points: np.ndarray) -> np.ndarray:
    return points * np.array([-1.0, 1.0, 1.0])


def _xyzw(quaternions: Float[np.ndarray, "J 4"]) -> Float[np.ndarray, "J 4"]:
    return np.roll(quaternions, -1, axis=-1)
