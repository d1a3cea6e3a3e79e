"""How markers move with betas and pose: the body's surface Jacobian, carried on by the triangles'
bases (M equation 2).

For any body, whatever its skinning and pose blend shapes, and for a few frames at once: memory is 9
M (3 J + B) numbers a frame.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.observe.markers import MarkerAttachment, predict_markers, triangle_bases


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
    return predict_markers(corners, _in_turn(attachment))


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
    attachment = _in_turn(attachment)
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
    found = surface_jacobian(
        body, betas, pose, trans, vertices=triangles.ravel(), dynamics=dynamics
    )
    by_pose = np.asarray(found.vertices_pose)
    by_betas = np.asarray(found.vertices_betas)
    if found.vertices_dynamics is not None:
        by_betas = np.concatenate([by_betas, found.vertices_dynamics], axis=-1)
    frames = (len(by_pose), *by_betas.shape[-3:])
    return (
        np.asarray(found.surface.vertices),
        np.broadcast_to(by_betas, frames),
        by_pose.reshape(*by_pose.shape[:3], -1),
    )


def _in_turn(attachment: MarkerAttachment) -> MarkerAttachment:
    """The same with corners numbered as `posed_corners` gives them."""
    order = np.arange(3 * attachment.num_markers).reshape(-1, 3)
    return MarkerAttachment(order, attachment.coefficients)
