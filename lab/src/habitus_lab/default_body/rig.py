"""MakeHuman's rig told in SMPL-X's 55 joints: centres, and skinning weights merged bone by bone."""

from __future__ import annotations

import re

import numpy as np
from scipy import sparse

from .sources import BODY_VERTICES, EYEBALLS, Source

JOINTS = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "jaw",
    "left_eye_smplhf",
    "right_eye_smplhf",
    *(
        f"{side}_{finger}{k}"
        for side in ("left", "right")
        for finger in ("index", "middle", "pinky", "ring", "thumb")
        for k in (1, 2, 3)
    ),
)
FINGERS = {"thumb": 1, "index": 2, "middle": 3, "ring": 4, "pinky": 5}  # MakeHuman numbers them
PARENTS = np.array(
    [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15]
    + [20 if k % 3 == 0 else 24 + k for k in range(15)]
    + [21 if k % 3 == 0 else 39 + k for k in range(15)]
)
JOINT_MIRROR = np.array(
    [
        JOINTS.index(re.sub("left|right", lambda m: "right" if m[0] == "left" else "left", name))
        for name in JOINTS
    ]
)

SMALLEST_WEIGHT = 1e-3
ASIS = 10947
PSIS = 11008  # base vertices of the left side
# Base vertex over the left ramus, 40 mm below the condyle. An opening jaw turns about the condyles,
# which glide forward meanwhile; both together are a turn about an axis through the rami. About the
# condyles alone the chin would go back by 39 mm at 25 degrees, about this axis by 25.
JAW_AXIS = 7686
MIRROR = 1_000_000  # added to a base vertex it means its twin on the right side

# Vertebral bodies: 60 to 75 mm under the skin of the back (45 to 55 at C7), as a share of the depth
# of pelvis, chest or neck, so that a belly does not move them. Levels: L4-L5, T12-L1, T8, C7.
# MakeHuman's cubes lie 20 to 60 mm deep.
_SPINE = {
    "spine1": {4195: 1.0, ASIS: 0.2, MIRROR + ASIS: 0.2, PSIS: -0.2, MIRROR + PSIS: -0.2},
    "spine2": {3988: 0.5, 4002: 0.5, 4088: 0.3, 3960: -0.3},
    "spine3": {3780: 0.5, 3960: 0.5 - 0.28, 4088: 0.28},
    "neck": {858: 0.55, 803: 0.45},
}
# joint -> what it is the weighted mean of: joint cubes by name (`*` is l or r), base vertices of
# the left side
_PLACES: dict[str, dict[str, float] | dict[int, float]] = {
    "pelvis": {"pelvis": 1.0},
    "head": {"head": 1.0},
    "jaw": {JAW_AXIS: 0.5, MIRROR + JAW_AXIS: 0.5},
    "eye_smplhf": {"*-eye": 1.0},
    **_SPINE,
    "collar": {"*-clavicle": 1.0},
    "shoulder": {"*-shoulder": 1.0},
    "elbow": {10039: 0.5, 10062: 0.5},
    "wrist": {"*-hand": 1.0},
    "hip": {"*-upper-leg": 1.0},
    "knee": {11248: 0.5, 13002: 0.5},
    "ankle": {11444: 0.5, 12939: 0.5},
    "foot": {"*-foot-1": 1.0},
    **{
        f"{name}{k}": {f"*-finger-{number}-{k}": 1.0}
        for name, number in FINGERS.items()
        for k in (1, 2, 3)
    },
}
# joint -> bones (regular expression over bone names without their side)
_BONES = {
    "pelvis": "root|pelvis|spine05",
    "spine1": "spine04|spine03",
    "spine2": "spine02",
    "spine3": "spine01|breast",
    "neck": "neck0.",
    "collar": "clavicle|shoulder01",
    "shoulder": "upperarm0.",
    "elbow": "lowerarm0.",
    "wrist": "wrist|metacarpal.",
    "hip": "upperleg0.",
    "knee": "lowerleg0.",
    "ankle": "foot",
    "foot": "toe.*",
    "jaw": "jaw|special04|oris0[1267]|tongue.*",
    **{f"{name}{k}": f"finger{number}-{k}" for name, number in FINGERS.items() for k in (1, 2, 3)},
}
_UPPER_LIP = (
    "oris05",
    "oris06",
)  # of the middle: they hang from the skull, their twins with a side from the jaw


def joint_points(source: Source) -> sparse.csr_matrix:
    """(55, 19158) matrix whose rows sum to one: joints are linear in the targets, but for the hips
    (`place_hips`).
    """
    rows = sparse.lil_matrix((len(JOINTS), len(source.vertices)))
    for k, name in enumerate(JOINTS):
        for vertex, weight in surface_places(name, source.mirror).items():
            rows[k, vertex] += weight
        side, part = _side_and_part(name)
        for place, weight in _PLACES[part].items():
            if isinstance(place, str):
                corners = source.groups["joint-" + place.replace("*", side[:1])]
                rows[k, corners] = weight / len(corners)
    return rows.tocsr()


def surface_places(joint: str, mirror: np.ndarray) -> dict[int, float]:
    """Base vertex -> weight, summing to one, of a joint that is a mean of surface points; empty for
    the others.
    """
    side, part = _side_and_part(joint)
    found = {}
    for place, weight in _PLACES[part].items():
        if not isinstance(place, str):
            right = (place >= MIRROR) != (side == "right")
            found[int(mirror[place % MIRROR]) if right else place % MIRROR] = weight
    return found


def _side_and_part(joint: str) -> tuple[str, str]:
    side, _, part = joint.partition("_")
    return (side, part) if part else ("", joint)


def place_hips(joints: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Joints (N, 55, 3) with hips by Harrington et al. 2007, from the pelvis' width and depth.

    Harrington, Zavatsky, Lawson, Yuan, Theologis 2007 ("Prediction of the hip joint centre in
    adults, children, and patients with cerebral palsy based on magnetic resonance imaging"), from
    the middle of the ASIS in the axes of the pelvis: back .24 depth + 9.9 mm, down .30 width + 10.9
    mm, outward .33 width + 7.3 mm. `vertices` (N, V, 3) of symmetric bodies.
    """
    front = vertices[:, ASIS].astype(float)
    back = vertices[:, PSIS].astype(float)
    width = 2 * front[:, 0]
    forward = (front - back) * [0, 1, 1]
    depth = np.linalg.norm(forward, axis=1)
    forward /= depth[:, None]
    up = np.stack([np.zeros(len(front)), forward[:, 2], -forward[:, 1]], 1)
    hip = (
        front * [0, 1, 1]
        - forward * (0.24 * depth + 0.0099)[:, None]
        - up * (0.30 * width + 0.0109)[:, None]
    )
    hip[:, 0] = 0.33 * width + 0.0073
    found = joints.copy()
    found[:, JOINTS.index("left_hip")] = hip
    found[:, JOINTS.index("right_hip")] = hip * [-1, 1, 1]
    return found


def bone_joint(bone: str) -> int:
    """Index of the joint that takes over a MakeHuman bone; whatever is not named belongs to the
    head (the face).
    """
    stem, _, side = bone.partition(".")
    if bone in _UPPER_LIP:
        return JOINTS.index("head")
    for part, pattern in _BONES.items():
        if re.fullmatch(pattern, stem):
            prefix = {"L": "left_", "R": "right_"}.get(side, "")
            return JOINTS.index(prefix + part if prefix + part in JOINTS else part)
    return JOINTS.index("head")


def bone_weights(source: Source) -> dict[str, np.ndarray]:
    """Bone -> (19158,) weights of all base vertices, normalised over bones; vertices without any
    (joint cubes) stay zero.
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
            f"{len(bare)} body vertices, the first is {bare[0]}, have no skinning weight in the "
            "rig's weight file"
        )
    return {bone: value / np.maximum(total, 1e-12) for bone, value in table.items()}


def joint_weights(
    source: Source, keep: np.ndarray, mirror: np.ndarray, influences: int = 4
) -> np.ndarray:
    """(V, 55) weights of the kept vertices: merged, symmetrised, at most `influences` each, rows
    sum to one.

    An eyeball follows its own joint alone, the lids the head.
    """
    merged = np.zeros((len(source.vertices), len(JOINTS)))
    for bone, value in bone_weights(source).items():
        merged[:, bone_joint(bone)] += value
    for group, side in zip(EYEBALLS, ("left", "right"), strict=True):
        merged[source.groups[group]] = np.eye(len(JOINTS))[JOINTS.index(f"{side}_eye_smplhf")]
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
    """The same for vertices on the midline, where a left joint goes only together with its right
    twin.
    """
    kept = np.minimum(weights, weights[:, JOINT_MIRROR])
    for row in kept:
        while (row > 0).sum() > count:
            weakest = np.flatnonzero(row > 0)[row[row > 0].argmin()]
            row[[weakest, JOINT_MIRROR[weakest]]] = 0
    return kept
