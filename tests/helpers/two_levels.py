"""A made-up body file of two levels of detail, 55 joints, twist, ages, expressions, dynamics:
random arrays.
"""

from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.joint_layouts import SMPLX

YEARS = np.array([5.0, 8, 12, 16, 20, 25, 40, 60, 80])
SPREADS = np.array([0.6, 0.8, 0.9, 1, 1, 1, 1, 1, 1])
DRIVERS = (20, 21, 16, 17, 1, 2)
FLIP = np.array([-1.0, 1.0, 1.0])


def two_level_arrays(
    pairs: int = 150, betas: int = 6, expressions: int = 4, seed: int = 0
) -> dict[str, Any]:
    """The arrays of a file; vertices k and k + pairs are partners, the first two thirds of each
    half are coarse.
    """
    rng = np.random.default_rng(seed)
    j = len(SMPLX.parents)
    v = 2 * pairs
    near = 2 * pairs // 3
    joints = np.cumsum(rng.normal(0, 0.05, (j, 3)), 0)
    joints -= joints[0]
    half = np.abs(joints[rng.integers(0, j, pairs)] + rng.normal(0, 0.06, (pairs, 3)))
    template = np.concatenate([half, half * FLIP])
    mirror = (np.arange(v) + pairs) % v
    coarse = np.sort(np.concatenate([np.arange(near), pairs + np.arange(near)]))
    weights = rng.dirichlet(np.ones(4), v).astype(np.float32)
    regressor = np.zeros((j, v))
    for row in regressor:
        row[rng.choice(coarse, 12, replace=False)] = rng.dirichlet(np.ones(12))
    rows, columns = np.nonzero(regressor)
    quads = np.array([rng.permutation(v)[:4] for _ in range(v)])
    uv = rng.uniform(size=(v + 20, 2))
    ages = rng.normal(0, 0.02, (v, 3, len(YEARS)))
    ages[..., YEARS == 25] = 0.0
    small = lambda *shape, size: rng.normal(0, size, shape).astype(np.float16)  # noqa: E731
    return {
        "v_template": template.astype(np.float32),
        "shapedirs": small(v, 3, betas, size=0.01),
        "expressiondirs": small(v, 3, expressions, size=0.004),
        "age_years": YEARS,
        "agedirs": ages.astype(np.float16),
        "age_spread": SPREADS,
        "quads": quads.astype(np.int32),
        "faces": np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32),
        "uv": uv.astype(np.float32),
        "quad_uv": rng.integers(0, len(uv), quads.shape).astype(np.int32),
        "hidden_quads": rng.random(len(quads)) < 0.1,
        "mirror": mirror.astype(np.int32),
        "coarse_vertices": coarse.astype(np.int32),
        "coarse_faces": np.array(
            [rng.permutation(len(coarse))[:3] for _ in range(2 * near)], np.int32
        ),
        "joint_names": np.array(SMPLX.joint_names),
        "parents": np.array(SMPLX.parents, np.int32),
        "joint_regressor_rows": rows.astype(np.int32),
        "joint_regressor_cols": columns.astype(np.int32),
        "joint_regressor_values": regressor[rows, columns].astype(np.float32),
        "skinning_index": np.array([rng.permutation(j)[:4] for _ in range(v)], np.int32),
        "skinning_value": weights,
        "posedirs_joints": np.array(DRIVERS, np.int32),
        "posedirs": small(v, 3, 9 * len(DRIVERS), size=0.005),
        "dynamicsdirs": small(v, 3, 2, size=0.004),
        "dynamics_history": rng.normal(0, 0.2, (3, 2, 2, 2)),
        "dynamics_drive": rng.normal(0, 0.01, (3, 2, 18)),
        "dynamics_joints": np.array(SMPLX.joint_names[:2]),
        "dynamics_rate": np.array(60.0),
        "dynamics_limits": np.full(18, 50.0),
        "dynamics_reach": np.array([[-2.0, -1.0], [2.0, 1.5]]),
        "dynamics_controls": np.array("joints"),
        "landmark_names": np.array(["nose_tip", "head_top", "left_index_tip"]),
        "landmark_vertices": coarse[[3, 40, 90]].astype(np.int32),
        "license": np.array("CC0-1.0"),
        "version": np.array("2.0.0"),
    }


def write_two_levels(path: Path, **options: Any) -> Path:
    """A file of these arrays."""
    np.savez_compressed(path, **two_level_arrays(**options))
    return path
