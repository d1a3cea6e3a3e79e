"""Tetrahedra around a mean body by fTetWild (the package pytetwild), finer about the joints that
fold skin.

fTetWild takes one edge length. So space is magnified about those joints first, the skin meshed, and
the nodes taken back: within `reach` of a joint by `scale`, beyond it moved away by what that takes.
Each such map is the gradient of a convex function, so that any sum of them folds nothing.
"""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import dataclass

import numpy as np

from habitus.body.model import BodyModel

from .frames import SIDES

SKIN = 13380  # vertices that are skin; eyeballs follow
STOP = 25.0
PASSES = 15
JOINTS = {
    "elbow": (1.9, 0.055),
    "knee": (1.7, 0.075),
    "shoulder": (1.3, 0.08),
    "hip": (1.2, 0.10),
    "wrist": (1.3, 0.04),
}
INVERSIONS = 60


@dataclass(frozen=True)
class MeshRule:
    """Edge length and envelope, of the box's diagonal after magnification; how much of `JOINTS` the
    joints get.
    """

    edge: float = 0.0125
    envelope: float = 1.0e-3
    fine: float = 1.0


FINE = MeshRule()
COARSE = MeshRule(edge=0.028, envelope=1.5e-3, fine=0.0)
"""For motion, which takes many frames: a sixth of the tetrahedra."""


def magnified(points: np.ndarray, joints: dict[str, np.ndarray], share: float = 1.0) -> np.ndarray:
    """Points (P, 3) in magnified space."""
    out = points.copy()
    for name, (scale, reach) in JOINTS.items():
        for side in SIDES:
            off = points - joints[f"{side}_{name}"]
            away = np.linalg.norm(off, axis=1, keepdims=True)
            out += share * (scale - 1) * off * np.minimum(1, reach / np.maximum(away, 1e-12))
    return out


def taken_back(points: np.ndarray, joints: dict[str, np.ndarray], share: float = 1.0) -> np.ndarray:
    """The inverse of `magnified`, by Newton's method along every point's way."""
    found = points.copy()
    step = 1e-6
    for _ in range(INVERSIONS):
        wrong = points - magnified(found, joints, share)
        if np.abs(wrong).max() < 1e-10:
            break
        sides = [
            (
                magnified(found + step * e, joints, share)
                - magnified(found - step * e, joints, share)
            )
            / (2 * step)
            for e in np.eye(3)
        ]
        found = found + np.linalg.solve(np.stack(sides, 2), wrong[..., None])[..., 0]
    return found


def mesh_cage(body: BodyModel, rule: MeshRule, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (N, 3) and tetrahedra (T, 4) around the skin of a body with SMPL-X's joints, in some
    minutes.
    """
    import pytetwild

    joints = dict(zip(body.joint_names, body.rest_joints(), strict=True))
    faces = body.faces[(body.faces < SKIN).all(1)].astype(np.int32)
    skin = magnified(body.v_template[:SKIN], joints, rule.fine)
    options = {
        "epsilon": rule.envelope,
        "stop_energy": STOP,
        "num_opt_iter": PASSES,
        "num_threads": threads,
    }
    with (
        tempfile.TemporaryDirectory() as scrap,
        contextlib.chdir(scrap),
    ):  # it leaves a file where it runs
        nodes, tets = pytetwild.tetrahedralize(skin, faces, edge_length_fac=rule.edge, **options)
    return taken_back(np.asarray(nodes, float), joints, rule.fine), np.asarray(tets, np.int64)
