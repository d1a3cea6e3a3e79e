"""Markers that ride on a surface: the marker function of MoSh (M 4.2, equation 2).

A marker sits in the orthonormal basis of a triangle (a, b, c): t the unit edge b - a, n the unit normal, s = n x t:

    x = a + c_n n + c_t t + c_s s,        (c_n, c_t, c_s) fixed from the rest pose.

This is the reference in torch, which autodiff can differentiate; `habitus.observe.marker_prediction` computes the
same fast.
"""

from dataclasses import dataclass
from typing import NamedTuple

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.errors import HabitusError


@dataclass(frozen=True)
class MarkerAttachment:
    """Where M markers sit: the triangle (a, b, c) of each and its place (c_n, c_t, c_s) in metres in that basis."""

    triangles: Int[np.ndarray, "M 3"]
    coefficients: Float[np.ndarray, "M 3"]

    def __post_init__(self) -> None:
        triangles = np.ascontiguousarray(self.triangles, dtype=np.int64)
        coefficients = np.ascontiguousarray(self.coefficients, dtype=np.float64)
        if triangles.ndim != 2 or triangles.shape[1] != 3 or coefficients.shape != triangles.shape:
            raise HabitusError(
                f"an attachment takes triangles and coefficients (M, 3), got {triangles.shape} and {coefficients.shape}"
            )
        object.__setattr__(self, "triangles", triangles)
        object.__setattr__(self, "coefficients", coefficients)

    @property
    def num_markers(self) -> int:
        """M."""
        return len(self.triangles)


class TriangleBases(NamedTuple):
    """Corner a of each triangle (*batch, M, 3) and its orthonormal basis (*batch, M, 3, 3) with the columns n, t, s."""

    origin: Float[Tensor, "*batch M 3"]
    basis: Float[Tensor, "*batch M 3 3"]


def triangle_bases(vertices: Float[Tensor, "*batch V 3"], triangles: Int[np.ndarray, "M 3"] | Tensor) -> TriangleBases:
    """Corner a and basis (n, t, s) of each triangle (M figure 3): t = (b - a)/|b - a|, n the unit normal, s = n x t."""
    index = torch.as_tensor(triangles, device=vertices.device)
    a, b, c = (vertices[..., index[:, k], :] for k in range(3))
    t = torch.nn.functional.normalize(b - a, dim=-1, eps=1e-30)
    n = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-30)
    return TriangleBases(a, torch.stack((n, t, torch.linalg.cross(n, t)), dim=-1))


def predict_markers(vertices: Float[Tensor, "*batch V 3"], attachment: MarkerAttachment) -> Float[Tensor, "*batch M 3"]:
    """Markers carried by a posed surface, in its frame and metres: x = a + [n t s] c (M equation 2)."""
    origin, basis = triangle_bases(vertices, attachment.triangles)
    coefficients = torch.as_tensor(attachment.coefficients, dtype=vertices.dtype, device=vertices.device)
    return origin + (basis @ coefficients[:, :, None])[..., 0]


def attach(
    latent_markers: Float[np.ndarray, "M 3"] | Tensor,
    rest_vertices: Float[np.ndarray, "V 3"] | Tensor,
    faces: Int[np.ndarray, "F 3"] | Tensor,
    *,
    triangles: Int[np.ndarray, "M 3"] | None = None,
) -> MarkerAttachment:
    """Express latent markers (rest pose, metres) in the bases of their closest triangles or of given ones (vertex ids).

    Raises HabitusError where a marker is not finite or its triangle has no area.
    """
    points, vertices = _array(latent_markers), _array(rest_vertices)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise HabitusError(f"latent markers must be finite and (M, 3), got {points.shape}; drop the missing ones")
    if triangles is None:
        triangles = closest_triangles(points, vertices, faces)
    origin, basis = triangle_bases(torch.as_tensor(vertices), triangles)
    unit = torch.linalg.det(basis)
    if (unit < 0.5).any():
        bad = int(torch.argmin(unit))
        raise HabitusError(f"marker {bad} lies on triangle {triangles[bad].tolist()} of no area; attach it elsewhere")
    coefficients = (basis.transpose(-1, -2) @ (torch.as_tensor(points) - origin)[:, :, None])[..., 0]
    return MarkerAttachment(triangles, coefficients.numpy())


def closest_triangles(
    points: Float[np.ndarray, "M 3"],
    vertices: Float[np.ndarray, "V 3"] | Tensor,
    faces: Int[np.ndarray, "F 3"] | Tensor,
) -> Int[np.ndarray, "M 3"]:
    """Vertex ids (a, b, c) of the triangle closest to each point."""
    index = np.ascontiguousarray(_array(faces, np.int64))
    _, nearest, _ = igl.point_mesh_squared_distance(np.ascontiguousarray(points), _array(vertices), index)
    return index[np.asarray(nearest).reshape(-1)]


def _array(values: np.ndarray | Tensor, dtype: type = np.float64) -> np.ndarray:
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    return np.ascontiguousarray(values, dtype=dtype)
