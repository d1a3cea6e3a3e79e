"""Markers that ride on a surface: the marker function of MoSh (M 4.2, equation 2).

A marker sits in the orthonormal basis of a triangle (a, b, c): t the unit edge b - a, n the unit
normal, s = n x t:

    x = a + c_n n + c_t t + c_s s,        (c_n, c_t, c_s) fixed from the rest pose.

This is the reference, in NumPy or in torch, which autodiff can differentiate;
`habitus.observe.marker_prediction` computes the same fast.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import constant, cross, namespace, to_numpy
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.mesh.normals import vertex_normals
from habitus.mesh.proximity import closest_faces
from habitus.types import Array


@dataclass(frozen=True)
class MarkerAttachment:
    """Where M markers sit: the triangle (a, b, c) of each and its place (c_n, c_t, c_s) in metres
    in that basis.
    """

    triangles: Int[np.ndarray, "M 3"]
    coefficients: Float[np.ndarray, "M 3"]

    def __post_init__(self) -> None:
        triangles = np.ascontiguousarray(self.triangles, dtype=np.int64)
        coefficients = np.ascontiguousarray(self.coefficients, dtype=np.float64)
        if triangles.ndim != 2 or triangles.shape[1] != 3 or coefficients.shape != triangles.shape:
            raise HabitusError(
                f"an attachment takes triangles and coefficients (M, 3), got {triangles.shape} "
                f"and {coefficients.shape}"
            )
        object.__setattr__(self, "triangles", triangles)
        object.__setattr__(self, "coefficients", coefficients)

    @property
    def num_markers(self) -> int:
        """M."""
        return len(self.triangles)


class TriangleBases(NamedTuple):
    """Corner a of each triangle (*batch, M, 3) and its orthonormal basis (*batch, M, 3, 3) with the
    columns n, t, s.
    """

    origin: Float[Array, "*batch M 3"]
    basis: Float[Array, "*batch M 3 3"]


def triangle_bases(
    vertices: Float[Array, "*batch V 3"], triangles: Int[Array, "M 3"]
) -> TriangleBases:
    """Corner a and basis (n, t, s) of each triangle (M figure 3): t = (b - a)/|b - a|, n the unit
    normal, s = n x t.
    """
    xp = namespace(vertices)
    index = xp.asarray(triangles, device=vertices.device)
    a, b, c = (vertices[..., index[:, k], :] for k in range(3))
    t = _unit(b - a)
    n = _unit(cross(b - a, c - a))
    return TriangleBases(a, xp.stack((n, t, cross(n, t)), -1))


def _unit(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    xp = namespace(vectors)
    return vectors / xp.clip(xp.linalg.norm(vectors, axis=-1), 1e-30, None)[..., None]


def predict_markers(
    vertices: Float[Array, "*batch V 3"], attachment: MarkerAttachment
) -> Float[Array, "*batch M 3"]:
    """Markers carried by a posed surface, in its frame and metres: x = a + [n t s] c (M equation
    2).
    """
    origin, basis = triangle_bases(vertices, attachment.triangles)
    coefficients = constant(attachment.coefficients, vertices)
    return origin + (basis @ coefficients[:, :, None])[..., 0]


def attach(
    latent_markers: Float[np.ndarray, "M 3"],
    rest_vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"] | None,
    *,
    triangles: Int[np.ndarray, "M 3"] | None = None,
) -> MarkerAttachment:
    """Express latent markers (rest pose, metres) in the bases of their closest triangles or of
    given ones (vertex ids), for which ``faces`` may be None.

    Raises HabitusError where a marker is not finite or its triangle has no area.
    """
    points = to_numpy(latent_markers, np.float64)
    vertices = to_numpy(rest_vertices, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise HabitusError(
            f"latent markers must be finite and (M, 3), got {points.shape}; drop the missing ones"
        )
    if triangles is None:
        if faces is None:
            raise HabitusError("faces are None; expected faces (F, 3) or triangles (M, 3)")
        triangles = closest_triangles(points, vertices, faces)
    origin, basis = triangle_bases(vertices, triangles)
    unit = np.linalg.det(basis)
    if (unit < 0.5).any():
        bad = int(np.argmin(unit))
        raise HabitusError(
            f"marker {bad} lies on triangle {triangles[bad].tolist()} of no area; attach it "
            "elsewhere"
        )
    return MarkerAttachment(triangles, (basis.mT @ (points - origin)[:, :, None])[..., 0])


def closest_triangles(
    points: Float[np.ndarray, "M 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
) -> Int[np.ndarray, "M 3"]:
    """Vertex ids (a, b, c) of the triangle closest to each point; of equally close ones the first
    of the mesh.
    """
    index = to_numpy(faces, np.int64)
    return index[closest_faces(points, to_numpy(vertices, np.float64), index)]


def default_markers(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    which: Int[np.ndarray, " M"],
    distance: Float[np.ndarray, " M"],
) -> Float[np.ndarray, "M 3"]:
    """Where a layout places markers on a person at rest: v_i(betas) = S_h(i) + d_i N_h(i) (M
    equation 1), metres.

    ``which`` are the vertices h(i), ``distance`` those d_i from the skin. With the normals held,
    the derivative by betas is ``body.shapedirs[which]``.
    """
    vertices = body.rest_vertices(betas)
    return vertices[which] + distance[:, None] * vertex_normals(vertices, body.faces, which)
