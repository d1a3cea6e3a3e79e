"""Rigid frames that bones follow: the joints, and a few between them that a joint skeleton lacks.

- *Forearm*: its bones share the wrist's twist (pronation), none at the elbow, all at the wrist, in
  quarters.
- *Kneecap*: turns with the femur by half the knee's angle about the knee's joint, and sinks between
  the condyles, by
  `SINK` of the shank where the knee is fully bent.
- *Shoulder blade*: goes with the collar, and turns in its own plane, about a point midway between
  shoulder and upper
  spine, by a third of the arm's elevation (scapulohumeral rhythm, Inman et al. 1944), from -10 to
  +25 degrees, zero in
  the T-pose. The range is a choice: further down the blade's upper edge would push the trapezius
  up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from habitus.body.skinning import skinning_motions, world_motions
from habitus.rotations import matrix_from_rotvec, quaternion_from_rotvec

SIDES = ("left", "right")
QUARTERS = 4
SINK = 0.05
RHYTHM = 1 / 3
BLADE_DOWN, BLADE_UP = np.radians([-10.0, 25.0])


@dataclass(frozen=True)
class Frames:
    """Motions of joints and of the frames between them, for one person's rest joints (J, 3)."""

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    joints: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """The joints', then forearm quarters 1 to 4, kneecap and shoulder blade of each side."""
        more = []
        for side in SIDES:
            more += [f"{side}_forearm{k}" for k in range(1, QUARTERS + 1)] + [
                f"{side}_patella",
                f"{side}_scapula",
            ]
        return self.joint_names + tuple(more)

    def place(self, name: str) -> np.ndarray:
        """(3,) of a joint at rest."""
        return self.joints[self.joint_names.index(name)]

    def motions(self, pose: np.ndarray) -> np.ndarray:
        """(J, 3, 4) that take rest places along with the joints."""
        world = world_motions(matrix_from_rotvec(pose), self.joints, self.parents)
        return skinning_motions(world, self.joints)

    def all(self, pose: np.ndarray) -> np.ndarray:
        """(K, 3, 4) of all `names`."""
        motions = self.motions(pose)
        more = []
        for side in SIDES:
            more += self._forearm(side, pose, motions)
            more += [self._patella(side, pose, motions), self._scapula(side, pose, motions)]
        return np.concatenate([motions, np.stack(more)])

    def _forearm(self, side: str, pose: np.ndarray, motions: np.ndarray) -> list[np.ndarray]:
        elbow, wrist = (self.joint_names.index(f"{side}_{name}") for name in ("elbow", "wrist"))
        axis = self.joints[wrist] - self.joints[elbow]
        axis = axis / np.linalg.norm(axis)
        whole = quaternion_from_rotvec(pose[wrist])
        angle = 2 * np.arctan2(whole[1:] @ axis, whole[0])
        angle = (angle + np.pi) % (2 * np.pi) - np.pi
        shares = np.arange(1, QUARTERS + 1) / QUARTERS
        return [_then(motions[elbow], share * angle * axis, self.joints[elbow]) for share in shares]

    def _patella(self, side: str, pose: np.ndarray, motions: np.ndarray) -> np.ndarray:
        hip, knee, ankle = (
            self.joint_names.index(f"{side}_{name}") for name in ("hip", "knee", "ankle")
        )
        back = SINK * np.linalg.norm(self.joints[ankle] - self.joints[knee])
        back *= (1 - np.cos(np.linalg.norm(pose[knee]))) / 2
        turned = _then(motions[hip], 0.5 * pose[knee], self.joints[knee])
        turned[:, 3] -= back * turned[:, 2]
        return turned

    def _scapula(self, side: str, pose: np.ndarray, motions: np.ndarray) -> np.ndarray:
        collar, shoulder, elbow = (
            self.joint_names.index(f"{side}_{n}") for n in ("collar", "shoulder", "elbow")
        )
        arm = matrix_from_rotvec(pose[shoulder]) @ (self.joints[elbow] - self.joints[shoulder])
        up = np.arcsin(np.clip(arm[1] / np.linalg.norm(arm), -1, 1))
        angle = np.clip(RHYTHM * up, BLADE_DOWN, BLADE_UP) * (1 if side == "left" else -1)
        middle = (self.joints[shoulder] + self.place("spine3")) / 2
        return _then(motions[collar], np.array([0, 0, angle]), middle)


def _then(motion: np.ndarray, rotvec: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(3, 4): first a rotation about a rest point, then a motion."""
    turn = matrix_from_rotvec(rotvec)
    shift = centre - turn @ centre
    return np.concatenate(
        [motion[:, :3] @ turn, (motion[:, :3] @ shift + motion[:, 3])[:, None]], 1
    )
