# SPDX-License-Identifier: GPL-3.0-or-later
"""How bones lie: along their limbs, rolled so that elbows and fingers bend about +x and knees about
-x, as in the files of `habitus export`.
"""

import numpy as np

_MAIN = {
    "pelvis": "spine1",
    "spine3": "neck",
    "left_wrist": "left_middle1",
    "right_wrist": "right_middle1",
}
"""The child that a bone points to, where its joint has several."""
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_HANDS = ("wrist", "hand", *(f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)))
_AHEAD = ("left_eye_smplhf", "right_eye_smplhf")
_SHORTEST = 0.02


def resting(model, joints):
    """Axes (J, 3, 3; columns, y along the limb) and lengths (J,; m) of bones, in the body's axes.

    joints (J, 3): at rest, m.
    """
    axes, lengths = np.zeros((len(joints), 3, 3)), np.full(len(joints), 0.05)
    for joint, (name, parent) in enumerate(zip(model.joint_names, model.parents, strict=True)):
        below = [child for child, above in enumerate(model.parents) if above == joint]
        main = [child for child in below if model.joint_names[child] == _MAIN.get(name)]
        y = axes[parent, :, 1] if parent >= 0 else np.array([0.0, 1.0, 0.0])
        if name in _AHEAD or name.endswith("_foot"):
            y = np.array([0.0, 0.0, 1.0])
        elif below and name != "head":
            way = joints[main or below].mean(axis=0) - joints[joint]
            length = np.linalg.norm(way)
            if length > 1e-6:
                y, lengths[joint] = way / length, max(length, _SHORTEST)
        axes[joint] = _rolled(y, name.split("_")[-1] in _HANDS)
    return axes, lengths


def _rolled(y, palm):
    """Axes along y, with z forward, up where that is forward, or, of hands, towards the palm."""
    aim = np.array([0.0, -1.0, 0.0] if palm else [0.0, 1.0, 0.0] if y[2] > 0.7 else [0.0, 0.0, 1.0])
    across = np.cross(y, aim)
    if np.linalg.norm(across) < 0.1:  # along the limb: any other
        across = np.cross(y, np.roll(aim, 1))
    x = across / np.linalg.norm(across)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def rest_quaternion(bone):
    """How a pose bone rests turned in the body's axes."""
    return bone.bone.matrix_local.to_quaternion()
