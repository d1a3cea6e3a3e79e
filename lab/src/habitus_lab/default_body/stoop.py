"""The bent spine of old age, as a shape: the thorax bends forward over the lumbar spine, neck and
head come back up, and the arms keep their direction.

It is in the rest pose and not in a pose: people do not straighten it. Joints move with the skin,
because the regressed joints of a rigidly turned piece of the trunk are turned alike.
"""

from __future__ import annotations

import numpy as np

from .rig import JOINTS, PARENTS

# Turn of each joint about the x axis as a share of the kyphosis: between the lumbar spine and the
# upper thorax it sums to one; the pelvis stays, the lumbar spine leans back, and the head stays
# level before the trunk.
SHARES = {
    "spine1": -0.2,
    "spine2": 0.4,
    "spine3": 0.6,
    "neck": -0.5,
    "head": -0.3,
    "left_shoulder": -0.8,
    "right_shoulder": -0.8,
}


def stooped(
    body: np.ndarray, joints: np.ndarray, weights: np.ndarray, degrees: float
) -> np.ndarray:
    """Body (V, 3) in the T-pose whose thoracic spine is bent by `degrees` more; joints (J, 3) of
    JOINTS, weights (V, J).
    """
    turn = np.zeros(len(JOINTS))
    place = joints.copy()
    for joint, name in enumerate(JOINTS):
        parent = PARENTS[joint]
        turn[joint] = np.radians(degrees) * SHARES.get(name, 0.0)
        if parent >= 0:
            arm = joints[joint] - joints[parent]
            place[joint] = place[parent] + _about_x(turn[parent]) @ arm
            turn[joint] += turn[parent]
    moved = np.zeros_like(body)
    for joint in range(len(JOINTS)):
        own = np.flatnonzero(weights[:, joint])
        there = (body[own] - joints[joint]) @ _about_x(turn[joint]).T + place[joint]
        moved[own] += weights[own, joint, None] * there
    return moved


def _about_x(angle: float) -> np.ndarray:
    """(3, 3) rotation that carries y towards z."""
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
