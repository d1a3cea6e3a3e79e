# SPDX-License-Identifier: GPL-3.0-or-later
"""Bodies of files in SMPL's form (.npz): v_template, shapedirs, posedirs, J_regressor, weights,
kintree_table, f; of habitus' also hinge channels.
"""

from pathlib import Path

import numpy as np

from .core import Body, layouts, read_arrays
from .folds import fold_shapes

WANTED = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")


def read_body(path: str) -> Body:
    """The body of such a file, as habitus' save_body and the SMPL family's own releases write it.

    Raises ValueError for a file that holds none, and for one with another skinning than linear
    blend skinning.
    """
    held = read_arrays(path)
    try:
        return _body(path, held)
    except (ValueError, KeyError):
        raise
    except Exception as error:  # arrays of any kind and shape
        raise ValueError(f"its arrays do not fit together ({type(error).__name__})") from error


def _body(path: str, held: dict) -> Body:
    missing = [name for name in WANTED if name not in held]
    if missing:
        raise ValueError(
            f"holds no {missing[0]}; expected a body in SMPL's form, as habitus.save_body writes it"
        )
    if str(held.get("bs_style", "lbs")) != "lbs":
        raise ValueError(
            f"is skinned by {held['bs_style']}; Blender's armature has linear blend skinning"
        )
    template, shapedirs = (np.asarray(held[name], np.float64) for name in WANTED[:2])
    shapedirs = shapedirs[..., : int(held.get("num_betas", shapedirs.shape[-1]))]
    regressor, weights = (np.asarray(held[name], np.float64) for name in ("J_regressor", "weights"))
    parents = (
        np.asarray(held["kintree_table"][0]).astype(np.int32).astype(np.int64)
    )  # the root's is 2^32 - 1
    parents[0] = -1
    names = held["joint_names"] if "joint_names" in held else layouts().get(len(parents))
    if names is None:
        names = [f"joint_{k:02d}" for k in range(len(parents))]
    arrays = {
        "v_template": template,
        "shapedirs": shapedirs,
        "joint_template": regressor @ template,
        "joint_shapedirs": np.einsum("jv,vcb->jcb", regressor, shapedirs),
        "joint_names": np.array(names),
        "parents": parents,
        "faces": np.asarray(held["f"], np.int64),
    }
    return Body(
        arrays | _pose_shapes(held, list(map(str, names))) | _skin(weights), Path(path).stem
    )


def _pose_shapes(held: dict, names: list) -> dict:
    joints = len(names)
    shapes = np.asarray(held.get("posedirs", np.zeros((len(held["v_template"]), 3, 0))), np.float64)
    drivers = (
        np.asarray(held.get("posedirs_joints", np.arange(1, joints)))
        if shapes.shape[-1]
        else np.zeros(0, int)
    )
    if shapes.shape[-1] == 9 * (joints - 1):
        drivers = np.arange(1, joints)
    if shapes.shape[-1] != 9 * len(drivers):
        raise ValueError(
            f"has {shapes.shape[-1]} pose blend shapes; expected {9 * (joints - 1)}, nine a joint"
        )
    folds, shapes = fold_shapes(held, names, drivers.tolist(), shapes)
    blocks = [shapes[..., 9 * k : 9 * k + 9] for k in range(len(drivers))]
    moved = [np.flatnonzero(block.any((1, 2))) for block in blocks]
    return folds | {
        "drivers": drivers,
        "pose_start": np.cumsum([0, *map(len, moved)]),
        "pose_vertices": np.concatenate([np.zeros(0, np.int64), *moved]),
        "pose_values": np.concatenate(
            [np.zeros((0, 3, 9)), *(b[m] for b, m in zip(blocks, moved, strict=True))]
        ),
    }


def _skin(weights: np.ndarray) -> dict:
    most = int((weights > 0).sum(1).max())
    index = np.argsort(-weights, axis=1, kind="stable")[:, :most]
    return {"skinning_index": index, "skinning_value": np.take_along_axis(weights, index, 1)}
