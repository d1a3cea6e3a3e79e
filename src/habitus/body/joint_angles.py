"""Joint angles that a clinician or a coach reads: flexion, abduction, rotation, in degrees, from a
pose.

A joint's rotation relative to the segment above it is split, as Grood and Suntay split a knee's,
into flexion about the upper segment's x axis (to the left), then abduction about the z axis
(forward) that came along, then rotation about the lower segment's long axis y: R = Rx Rz Ry. Zero
is the body at rest, the T-pose. They are rotations of the model's joints; the axes of ISB's
conventions, which are built on landmarks, differ from the body's by some degrees.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel

_PARTS = {"flexion": 0, "abduction": 1, "rotation": 2}


@dataclass(frozen=True)
class _Turn:
    """One part of a joint's rotation. ``sign`` is the left side's and the middle's; ``mirrored``
    flips the right.
    """

    name: str
    joint: str
    base: str
    part: str
    sign: float
    mirrored: bool = False


_TURNS = (
    _Turn("hip flexion", "*hip", "pelvis", "flexion", -1.0),
    _Turn("hip abduction", "*hip", "pelvis", "abduction", 1.0, mirrored=True),
    _Turn("hip internal rotation", "*hip", "pelvis", "rotation", -1.0, mirrored=True),
    _Turn("knee flexion", "*knee", "*hip", "flexion", 1.0),
    _Turn("ankle dorsiflexion", "*ankle", "*knee", "flexion", -1.0),
    _Turn("trunk flexion", "spine3", "pelvis", "flexion", 1.0),
    _Turn("trunk bending to the left", "spine3", "pelvis", "abduction", -1.0),
    _Turn("trunk turn to the left", "spine3", "pelvis", "rotation", 1.0),
    _Turn("head flexion", "head", "spine3", "flexion", 1.0),
    _Turn("head turn to the left", "head", "spine3", "rotation", 1.0),
)
_SIDES = ("left", "right")


def joint_angles(
    body: BodyModel, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "T J 3"]
) -> dict[str, dict[str, Float[np.ndarray, " T"]]]:
    """Angles (degrees, without jumps of a whole turn) by name and side: ``angles["knee
    flexion"]["left"]``.

    Angles of the middle of the body have the side "". Shoulder elevation is the angle of the upper
    arm from where it hangs along the trunk; elbow flexion that between upper arm and forearm, 0
    when straight. What a body has no joints for is left out.
    """
    chains = Chains(body, np.asarray(pose, np.float64))
    angles: dict[str, dict[str, np.ndarray]] = {}
    for turn in _TURNS:
        for side in _SIDES if turn.joint.startswith("*") else ("",):
            rotation = chains.between(_sided(turn.base, side), _sided(turn.joint, side))
            if rotation is not None:
                sign = -turn.sign if turn.mirrored and side == "right" else turn.sign
                angles.setdefault(turn.name, {})[side] = (
                    sign * _split(rotation)[:, _PARTS[turn.part]]
                )
    rest = dict(zip(body.joint_names, body.rest_joints(np.asarray(betas, np.float64)), strict=True))
    for side in _SIDES:
        for name, angle in _arm(chains, rest, side).items():
            angles.setdefault(name, {})[side] = angle
    return angles


class Chains:
    """Rotations of joints relative to joints above them, of a pose (T, J, 3)."""

    def __init__(self, body: BodyModel, pose: np.ndarray) -> None:
        self.body = body
        self.pose = pose

    def between(self, base: str, joint: str) -> Rotation | None:
        """The rotation of ``joint`` relative to ``base``, frame by frame; None where one does not
        hang on the other.
        """
        names = self.body.joint_names
        if base not in names or joint not in names:
            return None
        chain = []
        at = names.index(joint)
        while at >= 0 and at != names.index(base):
            chain.append(at)
            at = self.body.parents[at]
        if at < 0 or not chain:
            return None
        whole = Rotation.from_rotvec(self.pose[:, chain[-1]])
        for k in reversed(chain[:-1]):
            whole = whole * Rotation.from_rotvec(self.pose[:, k])
        return whole


def _split(rotation: Rotation) -> Float[np.ndarray, "T 3"]:
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # at an abduction of 90 degrees the other two are one angle: any split will do
        return _steady(rotation.as_euler("XZY", degrees=True))


def _steady(angles: np.ndarray) -> np.ndarray:
    """Without jumps of a whole turn, and with the usual value as near to zero as whole turns
    allow.
    """
    smooth = np.unwrap(angles, period=360.0, axis=0)
    return smooth - 360.0 * np.round(np.median(smooth, axis=0) / 360.0)


def _arm(chains: Chains, rest: dict[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    shoulder, elbow, wrist = (f"{side}_{name}" for name in ("shoulder", "elbow", "wrist"))
    raised = chains.between("spine3", shoulder)
    bent = chains.between(shoulder, elbow)
    if raised is None or bent is None or wrist not in rest:
        return {}
    upper = rest[elbow] - rest[shoulder]
    fore = rest[wrist] - rest[elbow]
    return {
        "shoulder elevation": _between(raised.apply(upper), np.array([0.0, -1.0, 0.0])),
        "elbow flexion": _between(bent.apply(fore), upper),
    }


def _between(
    directions: Float[np.ndarray, "T 3"], other: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " T"]:
    across = np.linalg.norm(np.cross(directions, other), axis=1)
    return np.degrees(np.arctan2(across, directions @ other))


def _sided(name: str, side: str) -> str:
    return name.replace("*", f"{side}_")
