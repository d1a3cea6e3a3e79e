"""Random bodies of the SMPL family for tests and benchmarks: no licensed data, same shapes and
sparsity.
"""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.joint_layouts import LAYOUTS
from habitus.body.model import BodyModel
from habitus.body.pose_features import POSE_FEATURES

VERTICES = {"smpl": 6890, "smplh": 6890, "smplx": 10475, "mano": 778, "smal": 3889}


def official_arrays(
    family: str = "smpl",
    vertices: int | None = None,
    num_betas: int = 10,
    influences: int = 4,
    seed: int = 0,
) -> dict[str, Any]:
    """The arrays of a made-up model file under official names, exact in float32; pose blend shapes
    of 5 mm.
    """
    rng = np.random.default_rng(seed)
    layout = LAYOUTS[family]
    v = vertices or VERTICES[family]
    j = len(layout.parents)
    joints = np.zeros((j, 3))
    for k, parent in enumerate(layout.parents[1:], 1):
        joints[k] = joints[parent] + rng.normal(0, 0.12, 3)
    owner = rng.integers(0, j, v)
    template = joints[owner] + rng.normal(0, 0.06, (v, 3))
    distance = np.linalg.norm(template[:, None] - joints, axis=-1)
    near = np.argsort(distance, axis=1)[:, :influences]
    weights = np.zeros((v, j))
    share = rng.integers(1, 128, (v, influences)) * (rng.random((v, influences)) < 0.7)
    share[:, 0] = 1024 - share[:, 1:].sum(1)  # sums to one, exactly
    np.put_along_axis(weights, near, share / 1024, 1)
    regressor = np.zeros((j, v))
    for k in range(j):
        around = np.argsort(distance[:, k])[:24]
        regressor[k, around] = rng.dirichlet(np.ones(24))
    arrays = {
        "v_template": template,
        "shapedirs": rng.normal(0, 0.01, (v, 3, num_betas)),
        "posedirs": rng.normal(0, 0.005, (v, 3, 9 * (j - 1))),
        "J_regressor": regressor,
        "weights": weights,
    }
    arrays = {key: array.astype(np.float32).astype(np.float64) for key, array in arrays.items()}
    arrays["kintree_table"] = np.array([layout.parents, range(j)]).astype(np.uint32)
    corners = rng.integers(0, v, (2 * v, 1)) + np.cumsum(
        rng.integers(1, v // 3, (2 * v, 3)), axis=1
    )
    arrays["f"] = (corners % v).astype(np.uint32)
    return arrays | _hands(family, rng)


def _hands(family: str, rng: np.random.Generator) -> dict[str, Any]:
    sides = {"mano": ("",), "smplh": ("l", "r"), "smplx": ("l", "r")}.get(family, ())
    arrays: dict[str, Any] = {}
    for side in sides:
        arrays[f"hands_mean{side}"] = rng.normal(0, 0.2, 45)
        arrays[f"hands_components{side}"] = np.linalg.qr(rng.normal(size=(45, 45)))[0]
    if family == "smplx":
        arrays["lmk_faces_idx"] = rng.integers(0, 100, 51)
        arrays["lmk_bary_coords"] = rng.dirichlet(np.ones(3), 51)
    return arrays


def synthetic_body(family: str = "smpl", vertices: int | None = 240, **options: Any) -> BodyModel:
    """A made-up body of a family; ``vertices=None`` takes the family's own number of vertices."""
    arrays = official_arrays(family, vertices, **options)
    order = np.argsort(-arrays["weights"], axis=1, kind="stable")[:, : options.get("influences", 4)]
    return BodyModel(
        name=f"synthetic {family}",
        v_template=arrays["v_template"],
        shapedirs=arrays["shapedirs"],
        posedirs=arrays["posedirs"],
        joint_regressor=arrays["J_regressor"],
        skinning_index=order,
        skinning_value=np.take_along_axis(arrays["weights"], order, 1),
        parents=LAYOUTS[family].parents,
        faces=arrays["f"].astype(np.int64),
        joint_names=LAYOUTS[family].joint_names,
    )


def with_features(
    body: BodyModel, name: str, shape_features: int = 0, joints: tuple[int, ...] | None = None
) -> BodyModel:
    """The body with other, random pose blend shapes of 5 mm, driven by these features of some
    joints or all; exact in float32.
    """
    drivers = body.num_joints if joints is None else 1 + len(joints)
    shape = (body.num_vertices, 3, POSE_FEATURES[name].count(drivers, shape_features))
    posedirs = np.random.default_rng(7).normal(0, 0.005, shape).astype(np.float32)
    return replace(
        body,
        posedirs=posedirs,
        pose_features=name,
        shape_features=shape_features,
        pose_joints=joints,
    )


def write_official(path: Path, arrays: dict[str, Any]) -> Path:
    """A model file as ``smplx`` reads it: .npz, or .pkl with plain arrays."""
    if path.suffix == ".npz":
        np.savez(path, allow_pickle=False, **arrays)
    else:
        path.write_bytes(pickle.dumps(arrays, protocol=2))
    return path
