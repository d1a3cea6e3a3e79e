"""The default body's mesh: closed, symmetric, about 7,100 vertices, each of them an original one of the base mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .decimate import decimate
from .landmarks import landmark_vertices
from .rig import JOINTS, bone_joint, bone_weights
from .sliders import ANCHORS, MorphSpace
from .sources import Source
from .surface import left_half, whole

VERTICES = 7100
COARSE_VERTICES = 700  # of the skin that weighs people
# how dear a vertex is, by the joint that moves it: faces, ears, fingers and toes would otherwise eat the budget
IMPORTANCE = {"head": 0.30, "left_wrist": 0.5, "left_hand": 0.30, "left_foot": 0.45}


@dataclass(frozen=True)
class Skin:
    """Which base vertices are kept, and the triangles over them."""

    keep: np.ndarray  # (V,) base index of each vertex
    faces: np.ndarray  # (F, 3) triangles over 0..V-1, outward
    mirror: np.ndarray  # (V,) left-right twin
    full_faces: np.ndarray  # triangles of the closed skin before decimation, over base vertices
    coarse_faces: np.ndarray  # triangles of a very coarse skin, over base vertices


def build_skin(source: Source, morphs: MorphSpace) -> Skin:
    """Close, decimate and mirror the left half; landmarks stay."""
    half = left_half(source)
    bodies = _extremes(morphs)
    count = len(source.vertices)
    midline = source.mirror == np.arange(count)
    fixed = np.zeros(count, bool)
    fixed[list(landmark_vertices(source.mirror).values())] = True
    faces = whole(decimate(bodies, half, _importance(source), fixed, midline, VERTICES), source.mirror)
    coarse = decimate(bodies, half, np.ones(count), np.zeros(count, bool), midline, COARSE_VERTICES)
    keep = np.unique(faces)
    index = np.full(count, -1)
    index[keep] = np.arange(len(keep))
    mirror = index[source.mirror[keep]]
    if mirror.min() < 0:
        raise ValueError("a kept vertex has no kept twin: the skin is not symmetric")
    return Skin(keep, index[faces], mirror, whole(half, source.mirror), whole(coarse, source.mirror))


def _importance(source: Source) -> np.ndarray:
    weight = np.ones(len(source.vertices))
    for bone, value in bone_weights(source).items():
        weight += value * (IMPORTANCE.get(JOINTS[bone_joint(bone)], 1.0) - 1)
    return weight


def _extremes(morphs: MorphSpace) -> np.ndarray:
    """(S, W, 3) bodies far apart: a collapse must be cheap on all of them."""
    macro = {name: np.full(8, 0.5) for name in ANCHORS}
    macro["gender"] = np.array([0.5, 0, 1, 0, 1, 0, 1, 0.5])
    macro["weight"] = np.array([0.5, 0.1, 0.2, 1, 1, 0.6, 0.6, 1])
    macro["muscle"] = np.array([0.5, 0.5, 0.5, 0.3, 0.5, 0.5, 1, 0.2])
    macro["age"] = np.array([0, 0, 0, 0, 0.5, 0.8, 0.3, 0.8])
    return morphs.bodies(macro, np.full((8, 3), 1 / 3), np.zeros((8, len(morphs.local_names)))).astype(float)
