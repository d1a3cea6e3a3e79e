"""Bodies of many people in the T-pose: vertices and joints."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .people import Sliders
from .sliders import MorphSpace
from .tpose import RestPose

BATCH = 100


def apose(morphs: MorphSpace, sliders: Sliders) -> Iterator[np.ndarray]:
    """Batches of points (n, P, 3) as MakeHuman rests them."""
    for start in range(0, len(sliders.races), BATCH):
        part = slice(start, start + BATCH)
        macro = {name: value[part] for name, value in sliders.macro.items()}
        yield morphs.bodies(macro, sliders.races[part], sliders.local[part])


def tposed(morphs: MorphSpace, rest: RestPose, sliders: Sliders) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N,V,3) float32 and joints (N,55,3) of all people in the T-pose, pelvis at the origin.

    `morphs` spans `rest.points`: morphs.at(rest.points) of those over the base mesh.
    """
    vertices, joints = zip(*(rest(points) for points in apose(morphs, sliders)), strict=True)
    return np.concatenate(vertices), np.concatenate(joints)
