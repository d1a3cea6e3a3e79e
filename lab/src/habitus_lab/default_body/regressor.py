"""Joints from the rest surface: sparse weights on rings of vertices around each joint, rows summing
to one.

A joint lies inside a limb; vertices all around it, a little above and below, hold it in place
whatever the shape. Weights solve a ridge-regularised least-squares problem over many people (small,
but of either sign) and are exactly left-right symmetric. Joints that are means of surface points
(knees between their epicondyles) start from those.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .landmarks import LEFT, MIDLINE
from .rig import ASIS, JOINT_MIRROR, JOINTS, PARENTS, PSIS, surface_places

RINGS = 5  # along the limb
SECTORS = 16  # around it
RING_SPREAD = 0.075  # metres between the outer rings and the joint
FINGER_SPREAD = 0.012
PELVIS = (10923, LEFT["iliac_crest"], LEFT["belly_side"], LEFT["buttock"], MIDLINE["sacrum"])
PELVIS += (MIDLINE["l5"], MIDLINE["waist_front"], MIDLINE["navel"], MIDLINE["waist_back"])
RIDGE = 1e-6  # square metres: error that a unit of squared weight may cost


def fit_regressor(
    vertices: np.ndarray,
    joints: np.ndarray,
    weights: np.ndarray,
    mirror: np.ndarray,
    coarse: np.ndarray,
) -> sparse.csr_matrix:
    """(55, V) from bodies (N,V,3), their joints (N,55,3), the skinning weights (V,55); weighs
    `coarse` (C,) alone.
    """
    mean = vertices.mean(0)
    centres = joints.mean(0)
    weights = np.where(np.isin(np.arange(len(mean)), coarse)[:, None], weights, -1.0)
    rows = sparse.lil_matrix((len(JOINTS), len(mean)))
    for k, name in enumerate(JOINTS):
        if name.startswith("right_"):
            continue
        near = _eyeball(weights, k) if "eye" in name else _rings(mean, centres, weights, k)
        if JOINT_MIRROR[k] == k:
            near = np.union1d(near, mirror[near])
        known = surface_places(name, mirror)
        if name == "left_hip":  # placed by the whole pelvis, not by what surrounds it
            marks = np.intersect1d([ASIS, PSIS, *PELVIS], coarse)
            near = np.unique(np.concatenate([near, marks, mirror[near], mirror[marks]]))
        near = np.union1d(near, [*known]).astype(int)
        start = (
            np.array([known.get(v, 0.0) for v in near.tolist()])
            if known
            else np.full(len(near), 1 / len(near))
        )
        value = weigh(vertices[:, near], joints[:, k], start)
        row = np.zeros(len(mean))
        row[near] = value
        if JOINT_MIRROR[k] == k:
            row = 0.5 * (row + row[mirror])
        rows[k] = row
        rows[JOINT_MIRROR[k]] = row[mirror]
    return sparse.csr_matrix(rows)


def weigh(points: np.ndarray, target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Weights (K,) of points (N,K,3), summing to one, that come nearest to target (N,3); ridge
    keeps them near `start`.

    With r = w - start, sum(r) = 0 is kept by a Lagrange multiplier.
    """
    count, near = points.shape[:2]
    design = points.transpose(0, 2, 1).reshape(-1, near).astype(float)
    gap = target.reshape(-1) - design @ start
    system = np.zeros((near + 1, near + 1))
    system[:near, :near] = design.T @ design + RIDGE * count * np.eye(near)
    system[near, :near] = system[:near, near] = 1
    return start + np.linalg.solve(system, np.append(design.T @ gap, 0))[:near]


def _rings(mean: np.ndarray, centres: np.ndarray, weights: np.ndarray, joint: int) -> np.ndarray:
    """Vertices on rings around a joint: for each ring and sector, the one nearest to the sector's
    ray.
    """
    axis = _axis(centres, joint)
    mine = weights[:, _family(joint)].sum(1) > 0.5
    offset = mean - centres[joint]
    along = offset @ axis
    radial = offset - along[:, None] * axis
    first = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(axis, first)
    first /= np.linalg.norm(first)
    angle = np.arctan2(radial @ np.cross(axis, first), radial @ first)
    found = []
    spread = (
        FINGER_SPREAD
        if JOINTS[joint][-1] in "123" and "spine" not in JOINTS[joint]
        else RING_SPREAD
    )
    for place in np.linspace(-spread, spread, RINGS):
        for sector in np.arange(SECTORS) * 2 * np.pi / SECTORS:
            turn = np.abs(np.angle(np.exp(1j * (angle - sector))))
            miss = np.hypot(along - place, turn * np.linalg.norm(radial, axis=1)) + np.where(
                mine, 0.0, 10.0
            )
            if miss.min() < 0.03:
                found.append(int(miss.argmin()))
    return np.unique(found)


def _eyeball(weights: np.ndarray, joint: int) -> np.ndarray:
    return np.flatnonzero(weights[:, joint] >= 1)


def _axis(centres: np.ndarray, joint: int) -> np.ndarray:
    """Unit direction of the limb at a joint: from its parent to its first child."""
    children = np.flatnonzero(joint == PARENTS)
    same = [c for c in children if JOINTS[c].startswith(JOINTS[joint][:4])] or list(children)
    end = centres[same[0]] if same else 2 * centres[joint] - centres[PARENTS[joint]]
    if JOINTS[joint] in ("pelvis", "spine1", "spine2", "spine3"):
        return np.array([0.0, 1.0, 0.0])
    start = centres[PARENTS[joint]]
    if "hip" in JOINTS[joint] or "collar" in JOINTS[joint]:
        start = centres[joint]
    axis = end - start
    return axis / np.linalg.norm(axis)


def _family(joint: int) -> list[int]:
    """Joints whose flesh surrounds this one: itself, its children, its parent and grandparent."""
    parent = int(PARENTS[joint])
    elders = {parent, int(PARENTS[parent])} if parent >= 0 else set()
    return sorted(({joint} | elders | set(np.flatnonzero(joint == PARENTS).tolist())) - {-1})
