"""Markers that ride on a surface: the marker function of MoSh (M 4.2, equation 2).

A marker sits in the orthonormal basis of a triangle (a, b, c): t the unit edge b - a, n the unit normal, s = n x t:

    x = a + c_n n + c_t t + c_s s,        (c_n, c_t, c_s) fixed from the rest pose.

Written for NumPy arrays and torch tensors alike (autodiff goes through); `habitus.observe.marker_prediction` computes
the same fast for whole sequences, `habitus.observe.marker_jacobian` its derivatives.
"""

import sys
from dataclasses import dataclass
from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Float, Int

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

    origin: Any
    basis: Any


def triangle_bases(vertices: Any, triangles: Int[np.ndarray, "M 3"]) -> TriangleBases:
    """Corner a and basis (n, t, s) of each triangle (M figure 3): t = (b - a)/|b - a|, n the unit normal, s = n x t.

    vertices (*batch, V, 3): an array or a tensor; the answer is of its kind.
    """
    module = _module(vertices)
    index = module.asarray(triangles, device=vertices.device)
    a, b, c = (vertices[..., index[:, k], :] for k in range(3))
    t, n = _unit(b - a), _unit(module.linalg.cross(b - a, c - a))
    return TriangleBases(a, module.stack((n, t, module.linalg.cross(n, t)), -1))


def predict_markers(vertices: Any, attachment: MarkerAttachment) -> Any:
    """Markers (*batch, M, 3) on a posed surface, in its frame and metres: x = a + [n t s] c (M equation 2)."""
    origin, basis = triangle_bases(vertices, attachment.triangles)
    coefficients = _module(vertices).asarray(attachment.coefficients, dtype=vertices.dtype, device=vertices.device)
    return origin + (basis @ coefficients[:, :, None])[..., 0]


def attach(latent_markers: Any, rest_vertices: Any, faces: Any, *, triangles: Any = None) -> MarkerAttachment:
    """Express latent markers (M, 3) (rest pose, metres) in the bases of their closest triangles or of given ones.

    rest_vertices (V, 3), faces (F, 3), triangles (M, 3) vertex ids: arrays or tensors. Raises HabitusError where a
    marker is not finite or its triangle has no area.
    """
    points, vertices = _array(latent_markers), _array(rest_vertices)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise HabitusError(f"latent markers must be finite and (M, 3), got {points.shape}; drop the missing ones")
    if triangles is None:
        triangles = closest_triangles(points, vertices, faces)
    triangles = _array(triangles, np.int64)
    origin, basis = triangle_bases(vertices, triangles)
    unit = np.linalg.det(basis)
    if (unit < 0.5).any():
        bad = int(np.argmin(unit))
        raise HabitusError(f"marker {bad} lies on triangle {triangles[bad].tolist()} of no area; attach it elsewhere")
    return MarkerAttachment(triangles, (np.swapaxes(basis, -1, -2) @ (points - origin)[:, :, None])[..., 0])


def closest_triangles(points: Float[np.ndarray, "M 3"], vertices: Any, faces: Any) -> Int[np.ndarray, "M 3"]:
    """Vertex ids (a, b, c) of the triangle closest to each point."""
    index = _array(faces, np.int64)
    _, nearest, _ = igl.point_mesh_squared_distance(np.ascontiguousarray(points), _array(vertices), index)
    return index[np.asarray(nearest).reshape(-1)]


def _unit(vectors: Any) -> Any:
    """Unit vectors, zero where there is no direction."""
    return vectors / ((vectors * vectors).sum(-1) ** 0.5)[..., None].clip(1e-30)


def _module(values: Any) -> Any:
    """The module of an array's kind: torch or numpy."""
    return sys.modules[type(values).__module__.partition(".")[0]]


def _array(values: Any, dtype: type = np.float64) -> np.ndarray:
    values = values.detach().cpu() if hasattr(values, "detach") else values
    return np.ascontiguousarray(values, dtype=dtype)
