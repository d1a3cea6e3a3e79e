"""The body function of torch tensors on the CPU that want a gradient: compiled forwards and
backwards (`habitus.body.kernels`, `habitus.body.kernels_vjp`).

A gradient that is to be differentiated again goes through the readable form instead
(`habitus.body.skinning`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from habitus.body.body_arrays import VertexRows, add_blend_shapes
from habitus.body.kernels import joint_motions, posed_vertices, rows_kept
from habitus.body.kernels_vjp import joint_motions_vjp, posed_vertices_vjp
from habitus.body.skinning import skin, skinning_motions, world_motions
from habitus.rotations import matrix_from_rotvec


def moving_joints(
    pose: Float[Tensor, "b J 3"], rest_joints: Float[Tensor, "b J 3"], parents: tuple[int, ...]
) -> tuple[Float[Tensor, "b J 12"], Float[Tensor, "b J 3"], Float[Tensor, "b J 3 3"]]:
    """Skinning motions [R | p - R J] row by row, posed joints (m), and R - I of the joints' own
    rotations (rad).
    """
    return _JointMotions.apply(pose, rest_joints, parents)  # pyright: ignore


def moving_vertices(
    rows: VertexRows,
    shape: Float[Tensor, "b C"],
    features: Float[Tensor, "b F"] | None,
    motions: Float[Tensor, "b J 12"],
    trans: Float[Tensor, "b 3"],
) -> Float[Tensor, "b N 3"]:
    """Vertices (m) from coefficients of shape, what pose blend shapes are multiplied with, motions
    of the joints, and place (m), by linear blend skinning.
    """
    if features is None:
        features = shape.new_zeros(len(shape), 0)
    return _PosedVertices.apply(rows, shape, features, motions, trans)  # pyright: ignore


class _JointMotions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, pose: Tensor, rest_joints: Tensor, parents: tuple[int, ...]) -> Any:
        found = joint_motions(pose.numpy(), rest_joints.numpy(), np.array(parents))
        motions, posed, entries = (torch.from_numpy(array) for array in found)
        ctx.save_for_backward(pose, rest_joints, motions)
        ctx.parents = parents
        return motions, posed, entries.view(*pose.shape, 3)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        pose, rest_joints, motions = ctx.saved_tensors
        if torch.is_grad_enabled():
            return *_again(_readable_motions(ctx.parents), (pose, rest_joints), gradients), None
        to_motions, to_posed, to_entries = (part.numpy() for part in gradients)
        found = joint_motions_vjp(
            pose.numpy(), rest_joints.numpy(), np.array(ctx.parents), motions.numpy(),
            to_motions, to_posed, to_entries.reshape(*pose.shape[:2], 9),
        )  # fmt: skip
        return *(torch.from_numpy(array) for array in found), None


class _PosedVertices(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: VertexRows, shape: Tensor, features: Tensor, motions: Tensor, trans: Tensor
    ) -> Tensor:
        ctx.rows = rows
        base, bases, index, value = _arrays(rows, shape, features)
        parts = [shape.numpy()] if rows.local is not None else [shape.numpy(), features.numpy()]
        coefficients = np.ascontiguousarray(np.concatenate(parts, axis=-1))
        local = None if rows.local is None else (rows.local, features.contiguous().numpy())
        kept = np.empty((rows_kept(len(shape), base.dtype), len(base)), base.dtype)
        vertices = posed_vertices(
            base, coefficients, bases, motions.numpy(), trans.numpy(), index, value, "lbs", local,
            kept,
        )  # fmt: skip
        ctx.save_for_backward(shape, features, motions, trans, torch.from_numpy(kept))
        return torch.from_numpy(vertices)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:  # pyright: ignore
        rows = ctx.rows
        *inputs, kept = ctx.saved_tensors
        if torch.is_grad_enabled():
            return None, *_again(_readable_vertices(rows), tuple(inputs), (gradient,))
        shape, features, motions, _ = inputs
        _, bases, index, value = _arrays(rows, shape, features)
        local = None if rows.local is None else (rows.local, features.shape[1])
        with_shape = ctx.needs_input_grad[1] or (local is None and features.shape[1] > 0)
        to_coefficients, to_local, to_motions = posed_vertices_vjp(
            gradient.contiguous().numpy(), kept.numpy(), bases, motions.numpy(), index, value,
            local, with_shape,
        )  # fmt: skip
        to_shape = to_features = None
        if to_coefficients is not None:
            both = torch.from_numpy(to_coefficients)
            to_shape, to_features = both[:, : shape.shape[1]], both[:, shape.shape[1] :]
        if to_local is not None:
            to_features = torch.from_numpy(to_local)
        return None, to_shape, to_features, torch.from_numpy(to_motions), gradient.sum(1)


class _Arrays(NamedTuple):
    """The template, the blend shapes that are not local, and the skinning weights."""

    base: np.ndarray
    bases: np.ndarray
    index: np.ndarray
    value: np.ndarray


def _arrays(rows: VertexRows, shape: Tensor, features: Tensor) -> _Arrays:
    count = shape.shape[1] + (features.shape[1] if rows.local is None else 0)
    weights = rows.influences.index, rows.influences.value
    arrays: Any = rows.template, rows.blend_shapes[:count], *weights
    return _Arrays(*(array.numpy() for array in arrays))


def _readable_motions(parents: tuple[int, ...]) -> Callable[..., tuple[Tensor, ...]]:
    def motions(pose: Tensor, rest_joints: Tensor) -> tuple[Tensor, ...]:
        rotations = matrix_from_rotvec(pose)
        world = world_motions(rotations, rest_joints, parents)
        entries = rotations - torch.eye(3, dtype=pose.dtype)
        return skinning_motions(world, rest_joints).flatten(-2), world[..., 3], entries

    return motions


def _readable_vertices(rows: VertexRows) -> Callable[..., tuple[Tensor, ...]]:
    def vertices(
        shape: Tensor, features: Tensor, motions: Tensor, trans: Tensor
    ) -> tuple[Tensor, ...]:
        coefficients = torch.cat([shape, features], -1)
        rest = add_blend_shapes(rows.template, coefficients, rows.blend_shapes)
        moved = motions.unflatten(-1, (3, 4))
        return (skin("lbs", rest.unflatten(-1, (3, -1)), moved, trans, rows.influences),)

    return vertices


def _again(
    function: Callable[..., tuple[Tensor, ...]],
    inputs: tuple[Tensor, ...],
    gradients: tuple[Tensor, ...],
) -> tuple[Tensor | None, ...]:
    """Gradients that can themselves be differentiated."""
    wanted = [part for part in inputs if part.requires_grad]
    found = iter(
        torch.autograd.grad(
            function(*inputs), wanted, gradients, create_graph=True, allow_unused=True
        )
    )
    return tuple(next(found) if part.requires_grad else None for part in inputs)
