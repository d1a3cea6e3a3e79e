"""The numbers that growth tables speak of, on bodies of the full mesh in any pose with straight
legs and trunk.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .landmarks import LEFT, MIDLINE
from .sources import BODY_VERTICES

NUMBERS = (
    "stature",
    "weight",
    "sitting_height",
    "head_girth",
    "head_length",
    "head_breadth",
    "head_height",
)
DENSITY = 1.0  # kg per litre, lungs half full
# sitting height less (stature less crotch height), as a share of stature: the survey's median at
# 23-27 years
SITTING_OFFSET = 0.0065
GIRTH_NORMAL = np.array(
    [0.0, 1.0, 0.05]
)  # of the tape's plane around glabella and the back of the head
DIRECTIONS = 96


class Ruler:
    """Measures bodies of one mesh; the tape around the head lies on fixed places of the edges."""

    def __init__(self, reference: np.ndarray, mirror: np.ndarray, skin: np.ndarray):
        """reference (V, 3): a body; mirror (V,); skin (F, 3): triangles of the closed skin without
        eyeballs.
        """
        self.skin = skin
        self.midline = np.flatnonzero(mirror[:BODY_VERTICES] == np.arange(BODY_VERTICES))
        middle = reference[[MIDLINE["glabella"], MIDLINE["head_back"]]].mean(0)
        edges = np.unique(
            np.sort(np.concatenate([skin[:, [0, 1]], skin[:, [1, 2]], skin[:, [2, 0]]]), 1), axis=0
        )
        height = (reference[:BODY_VERTICES] - middle) @ GIRTH_NORMAL
        edges = edges[height[edges[:, 0]] * height[edges[:, 1]] < 0]
        share = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
        index = np.tile(np.arange(len(edges)), 2), edges.T.ravel()
        self.ring = sparse.csr_matrix(
            (np.concatenate([1 - share, share]), index), (len(edges), BODY_VERTICES)
        )

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """(N, len(NUMBERS)) in metres and kilograms of bodies (N, V, 3)."""
        body = vertices[:, :BODY_VERTICES].astype(float)
        sole = body[:, :, 1].min(1)
        stature = body[:, :, 1].max(1) - sole
        crotch = body[:, self.midline, 1].min(1) - sole
        a, b, c = (body[:, self.skin[:, k]] for k in range(3))
        weight = 1000 * DENSITY * (a * np.cross(b, c)).sum((1, 2)) / 6
        girth = np.array([_hull_girth((self.ring @ each)[:, [0, 2]]) for each in body])
        length = np.linalg.norm(
            body[:, MIDLINE["glabella"]] - body[:, MIDLINE["head_back"]], axis=1
        )
        breadth = 2 * body[:, LEFT["head_side"], 0]
        height = body[:, MIDLINE["head_top"], 1] - body[:, MIDLINE["chin"], 1]
        sitting = stature * (1 + SITTING_OFFSET) - crotch
        return np.stack([stature, weight, sitting, girth, length, breadth, height], 1)


def _hull_girth(flat: np.ndarray) -> float:
    """Perimeter of the convex hull of points (K, 2): the mean width over all directions times pi
    (Cauchy).
    """
    angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    return float(
        (flat @ np.stack([np.cos(angle), np.sin(angle)])).max(0).sum() * (2 * np.pi / DIRECTIONS)
    )
