"""Keeps the halves of a body apart: between buttocks and thighs a child has less room than an
adult's shapes take.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .tpose import MIDLINE_GAP

TOP = 0.03  # metres above the pelvis joint: the cleft ends below
ROOM = 0.015  # metres from the midline: up to here the adult's distance, scaled, is kept
PULL = 3.0  # of a vertex to its place, over the surface's own stiffness
HOLD = 1e-4  # how firmly the rest of the surface stays
ROUNDS = 3


class Cleft:
    """Moves the sides of bodies of one mesh apart, smoothly."""

    def __init__(self, left: np.ndarray, mirror: np.ndarray, skin: np.ndarray):
        """left (V,) True for vertices of the left side; mirror (V,); skin (F, 3) triangles without
        eyeballs.
        """
        self.left = np.flatnonzero(left)
        self.mirror = mirror
        edges = np.concatenate([skin[:, [0, 1]], skin[:, [1, 2]], skin[:, [2, 0]]])
        edges = np.unique(np.sort(edges, 1), axis=0)
        links = sparse.coo_matrix(
            (np.ones(len(edges)), edges.T), (len(mirror), len(mirror))
        ).tocsr()
        links = links + links.T
        laplacian = sparse.diags(np.asarray(links.sum(1)).ravel()) - links
        self.stiff = laplacian @ laplacian + HOLD * sparse.identity(len(mirror))

    def __call__(self, body: np.ndarray, template: np.ndarray, scale: float) -> np.ndarray:
        """Body (V, 3) whose vertices lie as far from the midline as the template's, scaled, up to
        ROOM.
        """
        floor = np.maximum(scale * np.minimum(template[self.left, 0], ROOM), MIDLINE_GAP)
        floor[template[self.left, 1] > TOP] = MIDLINE_GAP
        body = body.copy()
        for _ in range(ROUNDS):
            short = floor - body[self.left, 0]
            near = self.left[short > 0]
            goal = np.zeros(len(body))
            goal[near], goal[self.mirror[near]] = short[short > 0], -short[short > 0]
            pull = PULL * (goal != 0)
            body[:, 0] += splu((self.stiff + sparse.diags(pull)).tocsc()).solve(pull * goal)
        body[self.left, 0] = np.maximum(body[self.left, 0], MIDLINE_GAP)
        body[self.mirror[self.left]] = body[self.left] * [-1, 1, 1]
        return body
