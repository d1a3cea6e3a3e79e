"""Bodies of many people in the T-pose: vertices and joints."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import sparse

from .elastic import Elastic
from .people import Sliders
from .rig import joint_points
from .skin import Skin
from .sliders import MorphSpace
from .sources import Source
from .tpose import EXTRA_CUBES, segment_weights, to_tpose

BATCH = 100


def crowd_morphs(source: Source, morphs: MorphSpace, keep: np.ndarray) -> MorphSpace:
    """Morphs over the kept vertices, then the 24 joints, then the two knuckles that tell the palm."""
    count = len(source.vertices)
    pick = sparse.csr_matrix((np.ones(len(keep)), (np.arange(len(keep)), keep)), (len(keep), count))
    corners = np.array([source.groups["joint-" + name] for name in EXTRA_CUBES])
    knuckles = sparse.csr_matrix(
        (np.full(corners.size, 1 / 8), (np.repeat(np.arange(len(corners)), 8), corners.ravel())), (len(corners), count)
    )
    return morphs.at(sparse.vstack([pick, joint_points(source), knuckles]).tocsr())


def apose(morphs: MorphSpace, sliders: Sliders) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Batches of vertices (n,V,3), joints (n,24,3), knuckles (n,2,3) as MakeHuman rests them."""
    for start in range(0, len(sliders.races), BATCH):
        part = slice(start, start + BATCH)
        macro = {name: value[part] for name, value in sliders.macro.items()}
        points = morphs.bodies(macro, sliders.races[part], sliders.local[part]).astype(float)
        yield points[:, :-26], points[:, -26:-2], points[:, -2:]


def tposed(source: Source, morphs: MorphSpace, skin: Skin, sliders: Sliders) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N,V,3) float32 and joints (N,24,3) of all people in the T-pose, pelvis at the origin."""
    weights = {name: value[skin.keep] for name, value in segment_weights(source).items()}
    elastic = Elastic(morphs.average()[:-26], skin.faces, weights, skin.mirror)
    vertices, joints = [], []
    for body, centres, knuckles in apose(morphs, sliders):
        posed, moved = to_tpose(body, centres, knuckles, weights)
        refined = [elastic.refine(rest, there) for rest, there in zip(body, posed, strict=True)]
        vertices.append(np.array(refined, np.float32))
        joints.append(moved)
    return np.concatenate(vertices), np.concatenate(joints)
