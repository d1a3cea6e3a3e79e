"""Closed lips at rest.

Bodies come into the T-pose with the jaw turned down by 1.5 degrees, because the lips of many would
cross (`tpose.JAW_OPEN`): the mean's lips stand 2 to 3 mm apart. Here the two lines of contact meet
again, the lower lip doing two thirds of it, and springs let no shape and no age move them apart.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import splu

from .contacts import Meetings
from .face_lines import FaceLines, bending, spread
from .intersections import intersecting_pairs

CLEARANCE = 7e-4  # metres between the closed lips, which random people's would cross with .2 mm
LOWER_SHARE = 2 / 3  # of the gap
ROUNDS = 6
SPRING = 30.0  # of a pair of facing lip vertices; the surface's own is 1


def closed_lips(
    arrays: dict[str, np.ndarray], lines: FaceLines, skins: tuple[np.ndarray, ...]
) -> dict[str, np.ndarray]:
    """`v_template`, `shapedirs` and `agedirs` with the lips closed; skins are triangles (F,3) that
    must not come to cut each other.
    """
    rest = arrays["v_template"].astype(float)
    lips = lines.lips
    form = bending(skins[0], len(rest))
    found = rest
    allowed = [len(intersecting_pairs(rest, faces)) for faces in skins]
    for _ in range(ROUNDS):
        below, above = lips.opposite(found)
        gap = np.maximum(found[lips.upper, 1] - below[:, 1] - CLEARANCE, 0)
        rise = np.maximum(above[:, 1] - found[lips.lower, 1] - CLEARANCE, 0)
        moved = np.zeros((len(lips.both), 3))
        moved[:, 1] = np.concatenate([(LOWER_SHARE - 1) * gap, LOWER_SHARE * rise])
        step = spread(form, lips.both, moved)
        share = 1.0
        while share > 0.05 and any(
            len(intersecting_pairs(found + share * step, faces)) > few
            for faces, few in zip(skins, allowed, strict=True)
        ):
            share *= 0.7
        if share <= 0.05:
            break
        found = found + share * step
    ties = Meetings(len(rest), {})
    ties.tie(lips.pairs(found), arrays["mirror"], SPRING)
    springs = ties.laplacian()
    solve = splu((form + springs).tocsc())

    def tied(name: str) -> np.ndarray:
        motion = arrays[name].astype(float).reshape(len(rest), -1)
        change = -solve.solve(springs @ motion)
        return (motion + change).reshape(arrays[name].shape).astype(arrays[name].dtype)

    return {
        "v_template": found.astype(np.float32),
        **{name: tied(name) for name in ("shapedirs", "agedirs") if name in arrays},
    }
