"""Markers that ride on a surface: the marker function of MoSh and its derivatives (M 4.2, eq. 2).

A marker sits in the orthonormal basis of a triangle (a, b, c): t the unit edge b - a, n the unit
normal, s = n x t:

    x = a + c_n n + c_t t + c_s s,        (c_n, c_t, c_s) fixed from the rest pose.

`predict_markers` is the reference, in NumPy or in torch, which autodiff can differentiate;
`habitus.observe.marker_prediction` computes the same fast. `marker_jacobian` carries the body's
surface Jacobian through the triangles' bases: for any body, whatever its skinning and pose blend
shapes, and for a few frames at once (memory: 9 M (3 J + B) numbers a frame).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import constant, cross, namespace, to_numpy
from habitus.body.jacobians import surface_jacobian
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


class MarkerJacobian(NamedTuple):
    """Predicted markers (m) and their derivatives, coefficients held; with `trans` they move one to
    one.
    """

    markers: Float[np.ndarray, "F M 3"]
    by_betas: Float[np.ndarray, "F M 3 B"]
    """And, behind the betas, by the dynamics, where such were given."""
    by_pose: Float[np.ndarray, "F M 3 N"]
    """N = 3 J, per rad."""
    bases: Float[np.ndarray, "F M 3 3"]
    """Columns n, t, s of the triangles: the derivatives to the coefficients."""


def predict_on_body(
    body: BodyModel,
    attachment: MarkerAttachment,
    betas: Float[np.ndarray, "*F B"],
    pose: Float[np.ndarray, "F J 3"],
    trans: Float[np.ndarray, "F 3"],
    dynamics: Float[np.ndarray, "F D"] | None = None,
) -> Float[np.ndarray, "F M 3"]:
    """Markers of F frames; betas are (B,) or one shape a frame (F, B)."""
    corners = posed_corners(body, attachment.triangles, betas, pose, trans, dynamics)
    return predict_markers(corners, in_turn(attachment))


def marker_jacobian(
    body: BodyModel,
    attachment: MarkerAttachment,
    betas: Float[np.ndarray, "*F B"],
    pose: Float[np.ndarray, "F J 3"],
    trans: Float[np.ndarray, "F 3"],
    dynamics: Float[np.ndarray, "F D"] | None = None,
) -> MarkerJacobian:
    """The markers of F frames and how they move; betas are (B,) or one shape a frame (F, B)."""
    corners, by_betas, by_pose = _corner_jacobian(
        body, attachment.triangles, betas, pose, trans, dynamics
    )
    attachment = in_turn(attachment)
    change = corner_weights(corners, attachment)
    return MarkerJacobian(
        predict_markers(corners, attachment),
        carry(change, by_betas),
        carry(change, by_pose),
        triangle_bases(corners, attachment.triangles).basis,
    )


def corner_weights(
    corners: Float[np.ndarray, "*F N 3"], attachment: MarkerAttachment
) -> Float[np.ndarray, "*F M 3 9"]:
    """K (3 x 9) of each marker: dx = K (da, db, dc), coefficients held. With e = b - a, f = c - a,
    q = [n t s] c:

    dx = da + (n x q)(s . de) / |e| + (t x q)(n . df - (f_t / |e|) n . de) / f_s - (s x q)(n . de) /
    |e|.
    """
    a, b, c = (corners[..., attachment.triangles[:, k], :] for k in range(3))
    basis = triangle_bases(corners, attachment.triangles).basis
    n, t, s = (basis[..., k] for k in range(3))
    q = (basis @ attachment.coefficients[..., None])[..., 0]
    length = np.linalg.norm(b - a, axis=-1)[..., None, None]
    along, across = (np.sum((c - a) * axis, axis=-1)[..., None, None] for axis in (t, s))
    lift = np.cross(t, q)[..., :, None] * n[..., None, :] / across
    by_e = (
        np.cross(n, q)[..., :, None] * s[..., None, :]
        - np.cross(s, q)[..., :, None] * n[..., None, :]
    ) / length
    by_e -= lift * along / length
    return np.concatenate([np.eye(3) - by_e - lift, by_e, lift], axis=-1)


def carry(
    change: Float[np.ndarray, "*F M 3 9"], corners: Float[np.ndarray, "*F N 3 n"]
) -> Float[np.ndarray, "*F M 3 n"]:
    """Derivatives of markers from those of their corners, three in a row for each."""
    return change @ corners.reshape(*corners.shape[:-3], change.shape[-3], 9, corners.shape[-1])


def posed_corners(
    body: BodyModel,
    triangles: Int[np.ndarray, "M 3"],
    betas: Float[np.ndarray, "*F B"],
    pose: Float[np.ndarray, "F J 3"],
    trans: Float[np.ndarray, "F 3"],
    dynamics: Float[np.ndarray, "F D"] | None = None,
) -> Float[np.ndarray, "F N 3"]:
    """Corners (N = 3 M, marker by marker) of the posed triangles."""
    surface = body(betas, pose, trans, vertices=triangles.ravel(), dynamics=dynamics)
    return np.asarray(surface.vertices)


def rest_joints(body: BodyModel, betas: Float[np.ndarray, " B"]) -> Float[np.ndarray, "J 3"]:
    """Joints (m) of a shaped body at rest."""
    return np.asarray(body.rest_joints(betas))


def _corner_jacobian(
    body: BodyModel, triangles: np.ndarray, betas: Any, pose: Any, trans: Any, dynamics: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (F, N, 3) and their derivatives to betas, and dynamics, (F, N, 3, B + D) and pose (F,
    N, 3, 3 J).
    """
    jacobian = surface_jacobian(
        body, betas, pose, trans, vertices=triangles.ravel(), dynamics=dynamics
    )
    by_pose = np.asarray(jacobian.vertices_pose)
    by_betas = np.asarray(jacobian.vertices_betas)
    if jacobian.vertices_dynamics is not None:
        by_betas = np.concatenate([by_betas, jacobian.vertices_dynamics], axis=-1)
    frames = (len(by_pose), *by_betas.shape[-3:])
    return (
        np.asarray(jacobian.surface.vertices),
        np.broadcast_to(by_betas, frames),
        by_pose.reshape(*by_pose.shape[:3], -1),
    )


def in_turn(attachment: MarkerAttachment) -> MarkerAttachment:
    """The same with corners numbered as `posed_corners` gives them."""
    order = np.arange(3 * attachment.num_markers).reshape(-1, 3)
    return MarkerAttachment(order, attachment.coefficients)
