"""Normals of clouds of points, and which way they point."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree

NEIGHBOURS = 16
LINKED = 8
AT_ONCE = 20_000
COARSE, AROUND = 3000, 24
"""Points that tell out from in, and how many neighbours each is held against."""


def plane_normals(
    points: Float[np.ndarray, "N 3"], neighbours: int = NEIGHBOURS
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "N K"]]:
    """The normal (unit, of either sign) of the plane through each point's neighbours, and these."""
    near = cKDTree(points).query(points, k=min(neighbours, len(points)))[1].reshape(len(points), -1)
    normals = np.empty_like(points)
    for begin in range(0, len(points), AT_ONCE):
        some = points[near[begin : begin + AT_ONCE]]
        some = some - some.mean(1, keepdims=True)
        normals[begin : begin + AT_ONCE] = np.linalg.eigh(some.transpose(0, 2, 1) @ some)[1][..., 0]
    return normals, near


def outward(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    near: Int[np.ndarray, "N K"],
    carry: bool = True,
) -> Float[np.ndarray, "N 3"]:
    """The same normals with one sign a sheet, carried from neighbour to neighbour, then outward on
    the whole.

    Hoppe et al. 1992: along the tree on which neighbours' normals change least. Every connected
    part is turned so that it is round outside: limbs and trunk are. Without ``carry`` the signs are
    trusted to agree, and only the whole is turned.
    """
    if not carry:
        return normals * (1.0 if _roundness(points, normals) >= 0.0 else -1.0)
    count = len(points)
    others = near[:, 1 : LINKED + 1]
    rows = np.repeat(np.arange(count), others.shape[1])
    bend = 1.0 - np.abs((normals[rows] * normals[others.ravel()]).sum(1)) + 1e-3
    tree = minimum_spanning_tree(
        coo_array((bend, (rows, others.ravel())), shape=(count, count)).tocsr()
    )
    tree = tree + tree.T
    sign = np.zeros(count)
    left = np.ones(count, dtype=bool)
    while left.any():
        first = int(np.flatnonzero(left)[0])
        order, before = breadth_first_order(tree, first, directed=False)
        _carry(order, before, normals, sign)
        left[order] = False
        if _roundness(points[order], normals[order] * sign[order, None]) < 0.0:
            sign[order] *= -1.0
    return normals * sign[:, None]


def agreed(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    others: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N 3"]:
    """The same normals, turned over where they and their neighbours look against ``others``, zero
    where not known.
    """
    near = cKDTree(points).query(points, k=min(NEIGHBOURS, len(points)))[1].reshape(len(points), -1)
    along = np.einsum("nc,nkc->nk", normals, normals[near])
    votes = (np.sign(along) * (normals * others).sum(1)[near]).mean(1)
    return np.where(votes < -0.1, -1.0, 1.0)[:, None] * normals


def _roundness(points: np.ndarray, normals: np.ndarray) -> float:
    """How far points stand out, along their normals, from the middles of what is around them."""
    some = slice(None, None, max(1, len(points) // COARSE))
    few = points[some]
    around = few[cKDTree(few).query(few, k=min(AROUND, len(few)))[1].reshape(len(few), -1)].mean(1)
    return float(((few - around) * normals[some]).sum())


def _carry(order: np.ndarray, before: np.ndarray, normals: np.ndarray, sign: np.ndarray) -> None:
    """Signs along a tree, from its root on."""
    sign[order[0]] = 1.0
    agree = np.ones(len(order))
    agree[1:] = np.sign((normals[order[1:]] * normals[before[order[1:]]]).sum(1))
    agree[agree == 0.0] = 1.0
    for place, parent, same in zip(
        order[1:].tolist(), before[order[1:]].tolist(), agree[1:].tolist(), strict=True
    ):
        sign[place] = sign[parent] * same
