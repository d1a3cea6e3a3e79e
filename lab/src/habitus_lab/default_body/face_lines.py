"""Lips and lids as pairs of facing curves, and smooth corrections that make the curves meet.

The linings of mouth and eye sockets (`hidden_quads`) end at the lips' and lids' edges. `edge_line`
walks outward from such an edge; its upper and lower half face each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

HOLD = 2e-3  # how firmly vertices stay: a correction fades over about five edges
LIP_STEPS = 1  # edges from the mouth's lining to where closed lips touch
LID_STEPS = 2  # from an eye socket's lining to the lid's front edge, the first before the eyeball
FIRM = 1e4  # how firmly constrained vertices take what they are given


@dataclass(frozen=True)
class Line:
    """Two facing curves: `upper` and `lower` are vertices sorted by x."""

    upper: np.ndarray
    lower: np.ndarray

    @property
    def both(self) -> np.ndarray:
        """All vertices."""
        return np.concatenate([self.upper, self.lower])

    def opposite(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (upper, 3) of the lower curve under the upper one's vertices, and (lower, 3) of
        the upper curve above the lower one's; same x.
        """
        return (
            _at(vertices[self.lower], vertices[self.upper, 0]),
            _at(vertices[self.upper], vertices[self.lower, 0]),
        )

    def aperture(self, vertices: np.ndarray) -> float:
        """Largest height (m) of the upper curve over the lower one."""
        below, _ = self.opposite(vertices)
        return float((vertices[self.upper, 1] - below[:, 1]).max())

    def pairs(self, vertices: np.ndarray) -> np.ndarray:
        """(K, 2) each vertex and the nearest one of the other curve."""
        gap = np.linalg.norm(vertices[self.upper][:, None] - vertices[self.lower][None], axis=2)
        up = np.stack([self.upper, self.lower[gap.argmin(1)]], 1)
        down = np.stack([self.upper[gap.argmin(0)], self.lower], 1)
        return np.unique(np.concatenate([up, down]), axis=0)


@dataclass(frozen=True)
class FaceLines:
    """The lips' line of contact, and the front edges of each eye's lids."""

    lips: Line
    left_lids: Line
    right_lids: Line


def face_lines(vertices: np.ndarray, quads: np.ndarray, hidden: np.ndarray) -> FaceLines:
    """The lines of a body (V,3) with quads (Q,4), of which `hidden` (Q,) line its pockets."""
    rims = _rims(vertices, quads, hidden)
    mouth = min(rims, key=lambda rim: vertices[rim, 1].mean())
    eyes = sorted(
        (rim for rim in rims if rim is not mouth), key=lambda rim: -vertices[rim, 0].mean()
    )
    skin = _edges(quads[~hidden], len(vertices))
    steps = LIP_STEPS, LID_STEPS, LID_STEPS
    return FaceLines(
        *(_line(vertices, skin, rim, k) for rim, k in zip((mouth, *eyes), steps, strict=True))
    )


def _rims(vertices: np.ndarray, quads: np.ndarray, hidden: np.ndarray) -> list[np.ndarray]:
    edge = np.intersect1d(quads[hidden], quads[~hidden])
    _, label = connected_components(_edges(quads[hidden], len(vertices)), directed=False)
    return [edge[label[edge] == k] for k in np.unique(label[edge])]


def _edges(quads: np.ndarray, count: int) -> sparse.csr_matrix:
    pairs = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    link = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (count, count))
    return (link + link.T).tocsr()


def _line(vertices: np.ndarray, skin: sparse.csr_matrix, rim: np.ndarray, steps: int) -> Line:
    """The ring so many edges outward from a rim, as halves: those that lie outward from the rim's
    upper and lower half, which its corners part.
    """
    half = np.zeros(len(vertices))
    x = vertices[rim, 0]
    sides = np.setdiff1d(rim, rim[[x.argmin(), x.argmax()]])
    _, label = connected_components(skin[sides][:, sides], directed=False)
    top = label == label[vertices[sides, 1].argmax()]
    half[sides] = np.where(top, 1.0, -1.0)
    inside = ring = rim
    for _ in range(steps):
        ring = np.setdiff1d(skin[inside].indices, inside)
        half[ring] = np.sign(skin[ring] @ half)
        inside = np.union1d(inside, ring)
    ring = ring[(vertices[ring, 0] > x.min()) & (vertices[ring, 0] < x.max())]
    ring = ring[np.argsort(vertices[ring, 0], kind="stable")]
    return Line(ring[half[ring] > 0], ring[half[ring] < 0])


def _at(curve: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.stack([x, *(np.interp(x, curve[:, 0], curve[:, k]) for k in (1, 2))], 1)


def bending(faces: np.ndarray, count: int, hold: float = HOLD) -> sparse.csc_matrix:
    """Quadratic form of a displacement's bending and size over the mesh's edges."""
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0
    )
    a, b = edges.T
    off = sparse.coo_matrix((np.ones(len(edges)), (a, b)), (count, count))
    off = (off + off.T).tocsr()
    smooth = sparse.diags(np.asarray(off.sum(1)).ravel()) - off
    return (smooth @ smooth + hold * sparse.identity(count)).tocsc()


def spread(form: sparse.csc_matrix, where: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """The smoothest displacement (V,3) with these values (N,3) at vertices `where` (N,)."""
    count = form.shape[0]
    firm = np.bincount(where, minlength=count) * FIRM
    goal = np.zeros((count, 3))
    np.add.at(goal, where, FIRM * displacement)
    return splu((form + sparse.diags(firm)).tocsc()).solve(goal)
