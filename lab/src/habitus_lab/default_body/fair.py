"""Flanks without a notch: below the armpit the T-pose is the smoothest surface between its rim.

Skinning lifts the latissimus with the arm and leaves the ribs, which on men breaks the flank into a
polygon. The region's vertices are placed where the sum of squared curvatures is least (bilaplacian,
cotangent weights of an average body); the rim keeps its places and its tangents. The places are
then fixed linear functions of the surroundings, the same ones for everybody.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .elastic import half_edges
from .landmarks import LEFT
from .shape_space import vertex_areas

BELOW_BREAST = 0.12  # metres from the breast's level down to the region's end
ARM = 0.7  # share of the upper arm in the skinning at its upper end
AXIS = 0.05  # metres from the midline to the line around which the region's sector lies
SECTOR = np.radians((-62.0, 50.0))  # from straight behind to straight before; 0 is aside


class Flank:
    """Fairs the region of bodies of one mesh in the T-pose, on both sides alike."""

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        weights: dict[str, np.ndarray],
        mirror: np.ndarray,
    ):
        """rest (V,3): an average body in the T-pose; weights: segment -> (V,)."""
        self.mirror = mirror
        self.region = _region(rest, weights)
        edges, stiffness = half_edges(rest, faces)
        count = len(rest)
        laplacian = sparse.coo_matrix((-stiffness, tuple(edges.T)), (count, count)).tocsr()
        laplacian = laplacian - sparse.diags(np.asarray(laplacian.sum(1)).ravel())
        energy = laplacian @ sparse.diags(1 / vertex_areas(rest, faces)) @ laplacian
        rows = energy[self.region].tocsc()
        rim = np.setdiff1d(np.unique(rows.tocoo().col), self.region)
        self.rim = rim
        inner = rows[:, self.region].toarray()
        self.places = -np.linalg.solve(inner, rows[:, rim].toarray())  # (R, K)

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices (N,V,3) with both regions faired."""
        faired = vertices.copy()
        moved = np.einsum("rk,nkc->nrc", self.places, vertices[:, self.rim])
        faired[:, self.region] = moved
        faired[:, self.mirror[self.region]] = moved * [-1, 1, 1]
        return faired


def _region(rest: np.ndarray, weights: dict[str, np.ndarray]) -> np.ndarray:
    """Vertices of the left flank, from below the breast's level up to the arm's underside.

    Trunk, collar and upper arm alone: the sector and the levels hold the hand, too.
    """
    torso = sum(weights[name] for name in ("trunk", "left_collar", "left_upper_arm")) > 0.999
    breast = rest[LEFT["breast"]]
    spread = rest[:, 0] - AXIS
    middle = 0.5 * (breast[2] + rest[LEFT["scapula_lower"], 2])
    angle = np.arctan2(rest[:, 2] - middle, spread)
    near = torso & (spread > 0) & (angle > SECTOR[0]) & (angle < SECTOR[1])
    armpit = rest[(weights["left_upper_arm"] > 0.5) & near, 1].min()
    level = (rest[:, 1] > breast[1] - BELOW_BREAST) & (rest[:, 1] < armpit + 0.04)
    return np.flatnonzero(near & level & (weights["left_upper_arm"] < ARM))
