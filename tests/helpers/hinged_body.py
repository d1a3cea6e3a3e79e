"""A body with made-up hinge channels at both knees."""

from dataclasses import replace

import numpy as np

from habitus.body.pose_features import Hinges

KNEE = "left_knee"
ROW = np.array([0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0, 0.0, -0.5])
"""Of vec(R - I): 1 - cos t about x."""


def with_hinges(body):
    """The body with four channels at both knees, at vertices that a knee drives."""
    rng = np.random.default_rng(0)
    joints = [body.joint_names.index(name) for name in (KNEE, "right_knee")]
    directions = np.zeros((body.num_vertices, 3, 4, 3))
    for k, joint in enumerate(joints):
        near = np.flatnonzero(body.skinning_weights[:, joint] > 0.2)
        directions[near, :, 2 * k : 2 * k + 2] = 0.01 * rng.normal(size=(len(near), 3, 2, 3))
    linear = 0.2 * rng.normal(size=(4, 9))
    bias = np.array([0.5, 0.9, 0.5, 0.9])
    hinges = Hinges(np.repeat(joints, 2), np.tile(ROW, (4, 1)), bias, linear, directions)
    return replace(body, hinges=hinges)
