"""What a shipped file holds, and writing it in one go."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from scipy import sparse

from .landmarks import landmark_vertices
from .rig import JOINTS, PARENTS
from .shape_space import ShapeSpace
from .topology import Topology
from .twist import TwistShapes

VERSION = "3.0.0"
LICENSE = "CC0-1.0"
INFLUENCES = 4
FIRST_SHAPES = 24  # those that measurements determine; readers take further ones only if asked
AGE_STEP = 2.0**-17  # metres: offsets of ages are rounded to 8 micrometres, and compress
LEFT_PUPIL = 13389  # of the full mesh: the front of the left eyeball
DESCRIPTION = (
    "habitus default body, {space} space: MakeHuman (MPFB 2) CC0 geometry, people rebuilt from "
    "the public ANSUR II "
    "survey; SMPL-X's 55 joints in SMPL's T-pose, metres, y up, facing +z, x to the body's left, "
    "pelvis joint at the "
    "origin; betas are unit normal; pose blend shapes {pose}"
)
TWIST_ALONE = "share twist along forearm, upper arm and thigh"  # as built, before flesh/learn.py
LEARNED = (
    "are learned from simulated flesh, damped where no pose was simulated, with hinge channels at "
    "knees and elbows, limited beyond the ranges of joints"
)


def asset_arrays(
    space: str,
    topology: Topology,
    shapes: ShapeSpace,
    regressor: sparse.csr_matrix,
    weights: np.ndarray,
    source_mirror: np.ndarray,
    twist: TwistShapes,
    expressions: np.ndarray,
    ages: tuple[np.ndarray, np.ndarray, np.ndarray],
    skew: np.ndarray,
) -> dict[str, np.ndarray]:
    """Every array of the file `space`.npz but gender's; weights (V, 55), expressions (V, 3, 10),
    ages: what `age_arrays` takes; skew (24,) the direction in which people
    are skewed.
    """
    index = np.argsort(-weights, 1, kind="stable")[:, :INFLUENCES]
    value = np.take_along_axis(weights, index, 1).astype(np.float32)
    landmarks = landmark_vertices(source_mirror, space)
    landmarks |= {"left_eye": LEFT_PUPIL, "right_eye": int(topology.mirror[LEFT_PUPIL])}
    triplets = regressor.tocoo()
    return {
        "v_template": shapes.mean.astype(np.float32),
        "shapedirs": shapes.shapedirs[..., :FIRST_SHAPES].astype(np.float16),
        "further_shapedirs": shapes.shapedirs[..., FIRST_SHAPES:].astype(np.float16),
        "people_skew": skew.astype(np.float32),
        "expressiondirs": expressions.astype(np.float16),
        **age_arrays(*ages),
        "posedirs": twist.posedirs.astype(np.float16),
        "posedirs_joints": twist.joints.astype(np.int32),
        "quads": topology.quads.astype(np.int32),
        "faces": topology.faces.astype(np.int32),
        "uv": topology.uv.astype(np.float32),
        "quad_uv": topology.quad_uv.astype(np.int32),
        "hidden_quads": topology.hidden,
        "mirror": topology.mirror.astype(np.int32),
        "coarse_vertices": topology.coarse.astype(np.int32),
        "coarse_faces": topology.coarse_faces.astype(np.int32),
        "joint_names": np.array(JOINTS),
        "parents": PARENTS.astype(np.int32),
        "joint_regressor_rows": triplets.row.astype(np.int32),
        "joint_regressor_cols": triplets.col.astype(np.int32),
        "joint_regressor_values": triplets.data.astype(np.float32),
        "skinning_index": index.astype(np.int32),
        "skinning_value": (value / value.sum(1, keepdims=True)).astype(np.float32),
        "landmark_names": np.array(list(landmarks)),
        "landmark_vertices": np.array(list(landmarks.values()), np.int32),
        "base_vertices": topology.base.astype(np.int32),
        "license": np.array(LICENSE),
        "version": np.array(VERSION),
        "description": np.array(DESCRIPTION.format(space=space, pose=TWIST_ALONE)),
    }


def age_arrays(years: np.ndarray, offsets: np.ndarray, spread: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of the ages: years (A,), offsets (V, 3, A) of the mean person of each from the
    template, and the spread (A,) of shapes beside stature.
    """
    rounded = np.round(offsets / AGE_STEP) * AGE_STEP
    return {
        "age_years": np.asarray(years, np.float32),
        "agedirs": rounded.astype(np.float32),
        "age_spread": np.asarray(spread, np.float32),
    }


def write_asset(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Compressed npz, written beside its place and moved there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.npz")
    np.savez_compressed(part, **arrays)
    os.replace(part, path)
