"""`normals.vertex_normals` of one mesh of torch tensors on the CPU, compiled, with derivatives of
every kind.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.mesh import normal_kernels
from habitus.mesh.array_normals import summed_at_corners, unit_sums


def is_compiled(vertices: Tensor, faces: Tensor) -> bool:
    """Whether the kernels take them: one mesh on the CPU whose faces name vertices that exist."""
    fits = (
        vertices.ndim == 2
        and vertices.dtype in (torch.float32, torch.float64)
        and vertices.device.type == "cpu"
    )
    return fits and len(faces) > 0 and int(faces.min()) >= 0 and int(faces.max()) < len(vertices)


def vertex_normals(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "T 3"]
) -> Float[Tensor, "V 3"]:
    """Unit normals of vertices, of which `is_compiled` holds."""
    return _VertexNormals.apply(vertices, faces)


class _VertexNormals(torch.autograd.Function):
    @staticmethod
    def forward(vertices: Tensor, faces: Tensor) -> Tensor:
        points = _array(vertices)
        normals = np.empty(points.shape, points.dtype)
        normal_kernels.normalize(_totals(points, faces), _tiny(points), normals)
        return torch.from_numpy(normals)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        vertices, faces = ctx.saved_tensors
        if torch.is_grad_enabled():  # to be derived once more
            return torch.func.vjp(lambda moved: unit_sums(moved, faces), vertices)[1](cotangent)[
                0
            ], None
        points = _array(vertices)
        gradient = np.zeros(points.shape, points.dtype)
        totals = _totals(points, faces)
        normal_kernels.vertex_normals_vjp(
            points, _array(faces), totals, _tiny(points), _array(cotangent), gradient
        )
        return torch.from_numpy(gradient), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: Any) -> Tensor:
        vertices, faces = ctx.saved_tensors
        a, b, c = (vertices[corner] for corner in faces.T)
        da, db, dc = (tangent[corner] for corner in faces.T)
        cross = torch.linalg.cross
        total = summed_at_corners(cross(b - a, c - a), faces, vertices)
        step = summed_at_corners(cross(db - da, c - a) + cross(b - a, dc - da), faces, vertices)
        squared = (total * total).sum(-1, keepdim=True)
        seen = squared > torch.finfo(vertices.dtype).tiny
        squared = torch.where(seen, squared, 1.0)
        return (
            (step - total * (total * step).sum(-1, keepdim=True) / squared) * seen / squared.sqrt()
        )

    @staticmethod
    def vmap(info: Any, in_dims: Any, vertices: Tensor, faces: Tensor) -> tuple[Tensor, int]:
        if in_dims[1] is not None:
            raise RuntimeError(
                "vmap over faces is not supported: meshes of one batch share their faces"
            )
        return unit_sums(vertices.movedim(in_dims[0], 0), faces), 0


def _totals(points: np.ndarray, faces: Tensor) -> np.ndarray:
    totals = np.zeros(points.shape)
    normal_kernels.sum_face_normals(points, _array(faces), totals)
    return totals


def _tiny(points: np.ndarray) -> float:
    return float(np.finfo(points.dtype).tiny)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
