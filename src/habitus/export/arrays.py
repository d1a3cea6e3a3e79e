"""Plain NumPy views of a body and the small geometry every export needs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

UP_AXES = {
    "+x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "+y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def up_rotation(up_axis: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes a capture's own world to one whose +y is up; ``up_axis`` is "+z", "y", "-x", …"""
    signed = up_axis if up_axis[:1] in "+-" else f"+{up_axis}"
    return np.array(UP_AXES[signed.lower()], dtype=np.float64)


@dataclass(frozen=True)
class BodyArrays:
    """A BodyModel's arrays as NumPy, float64, metres (shapes as in design: V vertices, J joints, B betas).

    What drives ``posedirs``, the body says (`habitus.body.model.BodyModel`).
    """

    template: Float[np.ndarray, "V 3"]
    shapedirs: Float[np.ndarray, "V 3 B"]
    posedirs: Float[np.ndarray, "V 3 P"] | None
    joints: Float[np.ndarray, "J 3"]
    joint_shapedirs: Float[np.ndarray, "J 3 B"]
    skinning_index: Int[np.ndarray, "V K"]
    skinning_value: Float[np.ndarray, "V K"]
    parents: tuple[int, ...]
    faces: Int[np.ndarray, "F 3"]
    joint_names: tuple[str, ...]


def to_numpy(array: Any) -> np.ndarray:
    """A tensor (dense or sparse) or array as a NumPy array that must not be written to."""
    if hasattr(array, "detach"):
        array = array.detach().cpu()
        array = (array.to_dense() if array.is_sparse else array).numpy()
    return np.asarray(array)


def body_arrays(body: Any) -> BodyArrays:
    """NumPy view of a ``BodyModel``."""
    template, shapedirs = (to_numpy(a).astype(np.float64) for a in (body.v_template, body.shapedirs))
    regressor = to_numpy(body.joint_regressor).astype(np.float64)
    return BodyArrays(
        template=template,
        shapedirs=shapedirs,
        posedirs=None if body.posedirs is None else to_numpy(body.posedirs).astype(np.float64),
        joints=regressor @ template,
        joint_shapedirs=np.tensordot(regressor, shapedirs, axes=1),
        skinning_index=to_numpy(body.skinning_index).astype(np.int64),
        skinning_value=to_numpy(body.skinning_value).astype(np.float64),
        parents=tuple(int(p) for p in body.parents),
        faces=to_numpy(body.faces).astype(np.int64),
        joint_names=tuple(str(name) for name in body.joint_names),
    )


def vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Unit normals, each the area-weighted mean of the faces around the vertex."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    around = np.cross(b - a, c - a)
    summed = np.stack(
        [np.bincount(faces.ravel(), np.repeat(around[:, k], 3), minlength=len(vertices)) for k in range(3)], axis=1
    )
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.where(length > 1e-12, summed / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])
