"""MakeHuman's rig told in SMPL's 24 joints: centres from joint cubes, skinning weights merged bone by bone."""

from __future__ import annotations

import re

import numpy as np
from scipy import sparse

from .sources import BODY_VERTICES, Source

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
JOINT_MIRROR = np.array(
    [JOINTS.index(re.sub("left|right", lambda m: "right" if m[0] == "left" else "left", name)) for name in JOINTS]
)

SMALLEST_WEIGHT = 1e-3
# base vertices over the left femur's lateral epicondyle (twice) and on both sides of the medial one
LEFT_EPICONDYLES = (11248, 11248, 13002, 13003)

# joint -> joint cube; `*` is l or r
_CUBES = {
    "pelvis": "pelvis", "spine1": "spine-4", "spine2": "spine-2", "spine3": "spine-1", "neck": "neck", "head": "head",
    "collar": "*-clavicle", "shoulder": "*-shoulder", "elbow": "*-elbow", "wrist": "*-hand", "hand": "*-finger-3-1",
    "hip": "*-upper-leg", "knee": "*-knee", "ankle": "*-ankle", "foot": "*-foot-1",
}  # fmt: skip
# joint -> bones (regular expression over bone names without their side)
_BONES = {
    "pelvis": "root|pelvis|spine05", "spine1": "spine04|spine03", "spine2": "spine02", "spine3": "spine01|breast",
    "neck": "neck0.", "collar": "clavicle|shoulder01", "shoulder": "upperarm0.", "elbow": "lowerarm0.",
    "wrist": "wrist|metacarpal.", "hand": "finger.*", "hip": "upperleg0.", "knee": "lowerleg0.", "ankle": "foot",
    "foot": "toe.*",
}  # fmt: skip


def joint_points(source: Source) -> sparse.csr_matrix:
    """(24, 19158) averaging matrix, so that joints are linear in the targets.

    A joint is the mean of its cube's eight corners; a knee is midway between its epicondyles, because the height
    targets of women move the knee's cube up to 6 cm along the leg, away from the knee.
    """
    rows, cols, values = [], [], []
    for k, name in enumerate(JOINTS):
        side, _, part = name.rpartition("_")
        corners = list(source.groups["joint-" + _CUBES[part].replace("*", side[:1])])
        if part == "knee":
            corners = list(LEFT_EPICONDYLES if side == "left" else source.mirror[list(LEFT_EPICONDYLES)])
        rows += [k] * len(corners)
        cols += corners
        values += [1 / len(corners)] * len(corners)
    return sparse.csr_matrix((values, (rows, cols)), (len(JOINTS), len(source.vertices)))


def bone_joint(bone: str) -> int:
    """Index of the SMPL joint that takes over a MakeHuman bone; whatever is not named belongs to the head (face,
    jaw, tongue).
    """
    stem, _, side = bone.partition(".")
    for part, pattern in _BONES.items():
        if re.fullmatch(pattern, stem):
            prefix = {"L": "left_", "R": "right_"}.get(side, "")
            return JOINTS.index(prefix + part if prefix + part in JOINTS else part)
    return JOINTS.index("head")


def bone_weights(source: Source) -> dict[str, np.ndarray]:
    """Bone -> (19158,) weights of all base vertices, normalised over bones; vertices without any (joint cubes) stay
    zero.
    """
    table = {bone: np.zeros(len(source.vertices)) for bone in source.weights}
    for bone, pairs in source.weights.items():
        if pairs:
            index, value = np.array(pairs).T
            table[bone][index.astype(int)] = value
    total = sum(table.values())
    bare = np.flatnonzero(total[:BODY_VERTICES] <= 0)
    if len(bare):
        raise ValueError(
            f"{len(bare)} body vertices, the first is {bare[0]}, have no skinning weight in the rig's weight file"
        )
    return {bone: value / np.maximum(total, 1e-12) for bone, value in table.items()}


def joint_weights(source: Source, keep: np.ndarray, mirror: np.ndarray, influences: int = 4) -> np.ndarray:
    """(V, 24) weights of the kept vertices: merged, symmetrised, at most `influences` each, rows sum to one."""
    merged = np.zeros((len(source.vertices), len(JOINTS)))
    for bone, value in bone_weights(source).items():
        merged[:, bone_joint(bone)] += value
    weights = merged[keep]
    weights = 0.5 * (weights + weights[mirror][:, JOINT_MIRROR])
    weights = _strongest(weights, influences)
    middle = mirror == np.arange(len(mirror))
    weights[middle] = _strongest_pairs(weights[middle], influences)
    left = mirror > np.arange(len(mirror))
    weights[mirror[left]] = weights[left][:, JOINT_MIRROR]
    return weights / weights.sum(1, keepdims=True)


def _strongest(weights: np.ndarray, count: int) -> np.ndarray:
    """Only the `count` largest of each row, the tiny ones dropped."""
    drop = np.argsort(weights, 1, kind="stable")[:, :-count]
    kept = weights.copy()
    np.put_along_axis(kept, drop, 0, 1)
    return np.where(kept < SMALLEST_WEIGHT, 0, kept)


def _strongest_pairs(weights: np.ndarray, count: int) -> np.ndarray:
    """The same for vertices on the midline, where a left joint goes only together with its right twin."""
    kept = np.minimum(weights, weights[:, JOINT_MIRROR])
    for row in kept:
        while (row > 0).sum() > count:
            weakest = np.flatnonzero(row > 0)[row[row > 0].argmin()]
            row[[weakest, JOINT_MIRROR[weakest]]] = 0
    return kept
