"""Damp learned pose blend shapes where no pose was simulated, and make them symmetric.

The formula is `habitus.learn.posing.rotation_prior`'s.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.posing.rotation_prior import damped, rotation_gram
from habitus_lab.default_body.rig import JOINT_MIRROR

MU = 0.003  # simulated poses change by .5 mm RMS, twisted elbows from 64 to 6 mm; .01: 1.0 and 6, and acromia sink
FLIP = np.array([-1.0, 1.0, 1.0])
FEATURES = POSE_FEATURES["rotations"]


def damped_body(body: BodyModel, poses: np.ndarray, weight: float = MU) -> BodyModel:
    """A body with damped, symmetric pose blend shapes; poses (N, J, 3) rad that were simulated."""
    assert body.posedirs is not None
    joints = np.array(body.drivers)
    features = FEATURES.value(poses)[:, joints]
    grams = np.einsum("ndi,ndj->dij", features, features) / len(features)
    posedirs = damped(body.posedirs.astype(float), grams, rotation_gram(FEATURES), weight)
    return replace(body, posedirs=symmetric(posedirs, joints, body.mirror), finer=None)


def symmetric(posedirs: np.ndarray, joints: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """The mean of pose blend shapes (V, 3, 9 D) and their mirror image: a vertex of the midline
    stays on it in symmetric poses.
    """
    partner = [list(joints).index(JOINT_MIRROR[joint]) for joint in joints]
    blocks = posedirs.reshape(*posedirs.shape[:2], len(joints), 9)
    image = blocks[mirror][:, :, partner] * FLIP[:, None, None] * np.outer(FLIP, FLIP).ravel()
    return ((blocks + image) / 2).reshape(posedirs.shape)
