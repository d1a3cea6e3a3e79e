"""Pose blend shapes that are their own mirror image."""

from __future__ import annotations

import numpy as np

from habitus_lab.default_body.rig import JOINT_MIRROR

FLIP = np.array([-1.0, 1.0, 1.0])


def symmetric(posedirs: np.ndarray, joints: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """The mean of pose blend shapes (V, 3, 9 D) and their mirror image: a vertex of the midline
    stays on it in symmetric poses.
    """
    partner = [list(joints).index(JOINT_MIRROR[joint]) for joint in joints]
    blocks = posedirs.reshape(*posedirs.shape[:2], len(joints), 9)
    image = blocks[mirror][:, :, partner] * FLIP[:, None, None] * np.outer(FLIP, FLIP).ravel()
    return ((blocks + image) / 2).reshape(posedirs.shape)
