"""What the shipped file holds, and writing it in one go."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from scipy import sparse

from .landmarks import landmark_vertices
from .rig import JOINTS, PARENTS
from .shape_space import ShapeSpace
from .skin import Skin

VERSION = "1.0.0"
LICENSE = "CC0-1.0"
DESCRIPTION = (
    "habitus default body: MakeHuman (MPFB 2) CC0 geometry, people rebuilt from the public ANSUR II survey; "
    "SMPL's 24 joints and T-pose, metres, y up, facing +z, x to the body's left, pelvis joint at the origin; "
    "betas are unit normal: 1 size (tall, heavy, male), 2 a longer trunk on shorter legs, 4 girth; no pose blend shapes"
)


def asset_arrays(
    skin: Skin,
    space: ShapeSpace,
    regressor: sparse.csr_matrix,
    weights: np.ndarray,
    source_mirror: np.ndarray,
    female: tuple[np.ndarray, float, float],
) -> dict[str, np.ndarray]:
    """Every array of the file; `female` is (weights (B,), bias, held-out accuracy), `weights` (V, 24)."""
    index = np.argsort(-weights, 1, kind="stable")[:, :4]
    value = np.take_along_axis(weights, index, 1).astype(np.float32)
    place = {int(base): k for k, base in enumerate(skin.keep)}
    landmarks = {name: place[base] for name, base in landmark_vertices(source_mirror).items()}
    triplets = regressor.tocoo()
    count = space.shapedirs.shape[-1]
    return {
        "v_template": space.mean.astype(np.float32),
        "shapedirs": space.shapedirs.astype(np.float16),
        "joint_regressor_rows": triplets.row.astype(np.int32),
        "joint_regressor_cols": triplets.col.astype(np.int32),
        "joint_regressor_values": triplets.data.astype(np.float32),
        "skinning_index": index.astype(np.int32),
        "skinning_value": (value / value.sum(1, keepdims=True)).astype(np.float32),
        "parents": PARENTS.astype(np.int32),
        "faces": skin.faces.astype(np.int32),
        "joint_names": np.array(JOINTS),
        "part": np.array(JOINTS)[index[:, 0]],
        "mirror": skin.mirror.astype(np.int32),
        "landmark_names": np.array(list(landmarks)),
        "landmark_vertices": np.array(list(landmarks.values()), np.int32),
        "base_vertices": skin.keep.astype(np.int32),
        "betas_mean": np.zeros(count, np.float32),
        "betas_std": np.ones(count, np.float32),
        "shape_scale": np.sqrt(space.variance[:count]).astype(np.float32),
        "female_direction": np.append(female[0], female[1]).astype(np.float32),
        "female_weights": female[0].astype(np.float32),
        "female_bias": np.float32(female[1]),
        "female_accuracy": np.float32(female[2]),
        "license": np.array(LICENSE),
        "version": np.array(VERSION),
        "description": np.array(DESCRIPTION),
    }


def write_asset(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Compressed npz, written beside its place and moved there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.npz")
    np.savez_compressed(part, **arrays)
    os.replace(part, path)
