"""Normals of triangles and vertices."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def face_normals(vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "T 3"]) -> Float[Tensor, "*batch T 3"]:
    """Normals of triangles, twice as long as their area (m^2), to the side from where they run counter-clockwise."""
    a, b, c = (vertices.index_select(-2, corner) for corner in faces.unbind(-1))
    return torch.linalg.cross(b - a, c - a)


def vertex_normals(vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "T 3"]) -> Float[Tensor, "*batch V 3"]:
    """Unit normals of vertices: the mean of the triangles around each, weighted by area.

    A vertex without triangles, or whose triangles cancel out, gets a zero; its gradient is finite.
    """
    corners = face_normals(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in faces.unbind(-1):
        total = total.index_add(-2, corner, corners)
    squared = (total * total).sum(-1, keepdim=True)
    seen = squared > torch.finfo(vertices.dtype).tiny
    return total * torch.where(seen, squared, torch.ones_like(squared)).rsqrt() * seen
