"""What MakeHuman's trunk lacks: boxy chest, waist and hips, the furrow and the hollow of the back,
and ribs that widen without the shoulders.

A waist with ANSUR's mean girth and breadth would be 33 mm too deep as an ellipse, hips 30 mm: real
trunks are flat in front, at the sides and behind, and round between. Sections of the hip grow on
the diagonals alone: flatter buttocks are no part of it. MakeHuman's depths grow about a section's
middle, so that weight would fill the back; no tape senses where a section lies fore and aft.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from .landmarks import LEFT, MIDLINE
from .postures import LIMBS
from .rig import JOINTS, bone_weights, joint_points
from .sliders import MorphSpace
from .sources import BODY_VERTICES, Source

BOXY = {
    "chest": 0.05,
    "waist": 0.05,
    "hip": 0.12,
}  # share of the radius: less before, behind and aside, more between
BOXY_REACH = {
    "chest": 0.13,
    "waist": 0.17,
    "hip": 0.15,
}  # metres above and below at which it has faded out
FURROW = 0.012  # metres
FURROW_REACH = (0.20, 0.26)  # metres below and above the navel
FURROW_HALF = 0.035  # metres to either side
HOLLOW = 0.012  # metres by which the waist lies further forward, judged by eye
HOLLOW_REACH = 0.24  # metres above and below the navel at which that has faded out
# these sliders move chest and shoulders alike; they fade out from the breast's level to the
# acromion's, and leave the arms where they are
RIBS_ALONE = ("torso-scale-horiz-decr-incr",)
NAMES = (*(f"{level}-boxy" for level in BOXY), "back-furrow")


def with_waist(morphs: MorphSpace, source: Source) -> MorphSpace:
    """The sliders with these morphs added, each from -1 to 1 about what MakeHuman has; the back
    hollow, and ribs apart from the shoulders.
    """
    body = morphs.average()
    trunk = _trunk(source)[:, None]
    hip = (joint_points(source)[JOINTS.index("left_hip")] @ body)[0]
    levels = {"chest": body[LEFT["breast"], 1], "waist": body[MIDLINE["navel"], 1], "hip": hip[1]}
    moves = [
        BOXY[level] * _boxy(body, levels[level], BOXY_REACH[level], level == "hip")
        for level in BOXY
    ]
    moves = np.stack([*moves, _furrow(body)]).astype(np.float32)
    moves *= trunk
    both = np.stack([-moves, moves], 1)
    kept = np.ones((len(morphs.local_names), len(body), 1), np.float32)
    kept[[morphs.local_names.index(name) for name in RIBS_ALONE]] = _below_shoulders(body, trunk)
    hollow = HOLLOW * _fade((body[:, 1] - body[MIDLINE["navel"], 1]) / HOLLOW_REACH)
    return replace(
        morphs,
        base=morphs.base + trunk * hollow[:, None] * [0, 0, 1.0],
        local_names=(*morphs.local_names, *NAMES),
        local_offsets=np.concatenate([morphs.local_offsets * kept[:, None], both]),
    )


def _boxy(body: np.ndarray, level: float, reach: float, diagonals_only: bool) -> np.ndarray:
    """Radius less by its own length before, behind and aside, more by it between; or more by twice
    its length between alone.
    """
    near = (np.abs(body[:, 1] - level) < 0.02) & (np.abs(body[:, 0]) < 0.05)
    middle = 0.5 * (body[near, 2].min() + body[near, 2].max())
    out = (body - [0, 0, middle]) * [1, 0, 1]
    turn = np.cos(4 * np.arctan2(out[:, 0], out[:, 2])) - (1.0 if diagonals_only else 0.0)
    return -out * (turn * _fade((body[:, 1] - level) / reach))[:, None]


def _below_shoulders(body: np.ndarray, trunk: np.ndarray) -> np.ndarray:
    """(W, 1) 1 on the trunk below the breasts, 0 on the shoulders and arms; joint cubes as the skin
    nearest to them.
    """
    low = body[LEFT["breast"], 1]
    high = body[LEFT["acromion"], 1]
    kept = trunk * _fade(np.maximum(body[:, 1:2] - low, 0) / (high - low))
    _, skin = KDTree(body[:BODY_VERTICES]).query(body[BODY_VERTICES:])
    return np.concatenate([kept[:BODY_VERTICES], kept[skin]])


def _furrow(body: np.ndarray) -> np.ndarray:
    navel = body[MIDLINE["navel"]]
    back = body[MIDLINE["waist_back"]]
    middle = 0.5 * (navel[2] + back[2])
    rise = body[:, 1] - navel[1]
    fade = _fade(rise / np.where(rise < 0, *FURROW_REACH)) * _fade(body[:, 0] / FURROW_HALF)
    depth = np.clip((middle - body[:, 2]) / 0.03, 0, 1)  # the back's half only
    return FURROW * (fade * depth)[:, None] * np.array([0, 0, 1.0])


def _fade(share: np.ndarray) -> np.ndarray:
    """1 at 0, 0 beyond 1, smooth."""
    return np.cos(0.5 * np.pi * np.clip(np.abs(share), 0, 1)) ** 2


def _trunk(source: Source) -> np.ndarray:
    """(W,) 1 on the body's trunk, 0 on its arms and off the body."""
    arms = [stem for limb in ("upper_arm", "forearm", "hand") for stem in LIMBS[limb][0]]
    share = 1 - sum(
        value for bone, value in bone_weights(source).items() if bone.startswith(tuple(arms))
    )
    return np.where(np.arange(len(share)) < BODY_VERTICES, share, 0.0)
