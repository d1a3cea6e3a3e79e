"""Bodies posed by compiled code: NumPy arrays, and tensors on the CPU that want no gradient."""

import sys
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.arrays import Kind, to_numpy
from habitus.body.kernels import joint_motions, posed_vertices
from habitus.body.pose_features import PoseFeatures, extended
from habitus.body.views import VertexRows
from habitus.types import Array


def are_plain(kind: Kind, *arrays: Array | None) -> bool:
    """Whether these are only numbers: no gradient is asked for, no transform of torch wraps
    them.
    """
    if kind.xp is np:
        return True
    torch = sys.modules["torch"]
    if (
        kind.device.type != "cpu"
        or kind.dtype not in (torch.float32, torch.float64)
        or torch.compiler.is_compiling()
    ):
        return False
    given = [array for array in arrays if array is not None]
    if torch.is_grad_enabled() and any(array.requires_grad for array in given):
        return False
    return torch.autograd.forward_ad._current_level < 0 and not any(map(_is_wrapped, given))


def _is_wrapped(array: Any) -> bool:
    torch = sys.modules["torch"]
    return type(array) is not torch.Tensor or torch._C._functorch.is_functorch_wrapped_tensor(array)


def posed_surface(
    rows: VertexRows,
    shaped: Float[Array, " M"] | None,
    rest_joints: Float[Array, "*#batch J 3"],
    parents: tuple[int, ...],
    driven: tuple[PoseFeatures, Float[Array, "*#batch C"], int, list[int]],
    skinning: str,
    pose: Float[Array, "*#batch J 3"],
    trans: Float[Array, "*#batch 3"],
    batch: tuple[int, ...],
    kind: Kind,
) -> tuple[Float[Array, "*batch N 3"], Float[Array, "*batch J 3"]]:
    """Posed vertices and joints (m) in the kind given, as `PreparedBody` says.

    ``shaped`` is the rest surface where all share one. ``driven``: the kind of pose features, the
    coefficients of shape and expression, how many of these the features are multiplied with, and
    the joints whose features count.
    """
    count = int(np.prod(batch, dtype=int))
    pose = _stacked(pose, 2, batch, count, whole=True)
    joints = _stacked(rest_joints, 2, batch, count)
    places = _stacked(trans, 1, batch, count, whole=True)
    motions, posed, entries = joint_motions(pose, joints, np.array(parents))
    features, betas, shape_features, drivers = driven
    coefficients = [] if shaped is not None else [_stacked(betas, 1, batch, count, whole=True)]
    local = None
    if rows.posedirs is not None:
        feature = features.of_pose(
            pose, entries.reshape(*pose.shape, 3) + np.eye(3, dtype=pose.dtype), drivers
        )
        shapes = _stacked(betas[..., :shape_features], 1, batch, count)
        local = None if rows.local is None else (rows.local, np.ascontiguousarray(feature))
        coefficients += [] if local else [extended(feature, shapes, shape_features)]
    base = to_numpy(rows.template if shaped is None else shaped)
    bases = to_numpy(rows.blend_shapes)
    bases = bases[0 if shaped is None else rows.num_shapes : rows.num_shapes if local else None]
    together = (
        np.concatenate(coefficients, axis=-1) if coefficients else np.zeros((count, 0), pose.dtype)
    )
    index = to_numpy(rows.influences.index)
    value = to_numpy(rows.influences.value)
    vertices = posed_vertices(base, together, bases, motions, places, index, value, skinning, local)
    posed += places[:, None]
    return tuple(
        _in_kind(found.reshape(*batch, found.shape[1], 3), kind) for found in (vertices, posed)
    )  # pyright: ignore


def _stacked(
    array: Array, axes: int, batch: tuple[int, ...], count: int, whole: bool = False
) -> np.ndarray:
    """The batch axes as one: of length 1 where all of a batch share the values (unless ``whole``),
    else ``count``.
    """
    plain = to_numpy(array)
    last = array.shape[array.ndim - axes :]
    if not whole and plain.size == np.prod(last, dtype=int):
        return plain.reshape(1, *last)
    return np.ascontiguousarray(np.broadcast_to(plain, (*batch, *last))).reshape(count, *last)


def _in_kind(array: np.ndarray, kind: Kind) -> Array:
    return array if kind.xp is np else kind.xp.from_numpy(array)
