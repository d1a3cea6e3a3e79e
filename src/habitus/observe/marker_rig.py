"""The part of a body that its markers need: corners of triangles, joints, and how shape and pose
move both.

Markers touch about 200 of some 7,000 vertices; `MarkerRig` keeps only those, as arrays that
compiled kernels take.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import to_numpy
from habitus.body.model import BodyModel
from habitus.body.pose_features import check_driven_by_rotations
from habitus.errors import HabitusError
from habitus.observe.markers import MarkerAttachment
from habitus.types import Array


class MarkerRig(NamedTuple):
    """Arrays of a body of fixed shape for the U corners under M markers (metres; all float64 and
    int64, C order).

    J joints, K influences a corner, B shape directions, P = 9 (J - 1), or 0 for a body without pose
    blend shapes. Build it with `marker_rig`; treat the arrays as read-only.
    """

    parents: Int[np.ndarray, " J"]
    """Parent of each joint, -1 for the root; a parent comes before its children."""
    rest_joints: Float[np.ndarray, "J 3"]
    joint_shapedirs: Float[np.ndarray, "J 3 B"]
    rest_corners: Float[np.ndarray, "U 3"]
    corner_shapedirs: Float[np.ndarray, "U 3 B"]
    corner_posedirs: Float[np.ndarray, "U 3 P"]
    """Offsets per entry of vec(R - I), rows first, joint 1 first (S 3.2)."""
    influences: Int[np.ndarray, "U K"]
    """Joints that move each corner; padding has weight 0."""
    weights: Float[np.ndarray, "U K"]
    triangles: Int[np.ndarray, "M 3"]
    """Corners (a, b, c) of each marker, as rows of the arrays above."""
    coefficients: Float[np.ndarray, "M 3"]
    """(c_n, c_t, c_s) of each marker in its triangle's basis."""

    @property
    def num_joints(self) -> int:
        """J."""
        return len(self.parents)

    @property
    def num_markers(self) -> int:
        """M."""
        return len(self.triangles)

    @property
    def num_betas(self) -> int:
        """B."""
        return self.corner_shapedirs.shape[2]


def marker_rig(
    body: BodyModel, betas: Float[Array, " B"], attachment: MarkerAttachment
) -> MarkerRig:
    """The rig of a body of shape `betas` under the markers of `attachment`.

    `betas` may be shorter than the body's: only that many shape directions are kept. Raises
    HabitusError for a body that is not skinned linearly (S 3) or whose pose blend shapes are not
    linear in vec(R - I) alone, and for an attachment to vertices that it does not have.
    """
    corners, triangles = np.unique(attachment.triangles, return_inverse=True)
    _check(body, betas, corners)
    shape = to_numpy(betas, np.float64)
    directions = to_numpy(body.shapedirs, np.float64)[:, :, : len(betas)]
    regressor = to_numpy(body.joint_regressor, np.float64)
    template = to_numpy(body.v_template, np.float64)
    joints = regressor @ template
    joint_directions = (regressor @ directions.reshape(len(directions), -1)).reshape(
        len(joints), 3, -1
    )
    rest = template[corners]
    corner_directions = np.ascontiguousarray(directions[corners])
    influences, weights = _trim(
        to_numpy(body.skinning_index[corners], np.int64),
        to_numpy(body.skinning_value[corners], np.float64),
    )
    posedirs = body.smpl_posedirs(corners)
    return MarkerRig(
        parents=np.asarray(body.parents, dtype=np.int64),
        rest_joints=joints + joint_directions @ shape,
        joint_shapedirs=np.ascontiguousarray(joint_directions),
        rest_corners=rest + corner_directions @ shape,
        corner_shapedirs=corner_directions,
        corner_posedirs=np.zeros((len(corners), 3, 0)) if posedirs is None else posedirs,
        influences=influences,
        weights=weights,
        triangles=np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.int64),
        coefficients=attachment.coefficients,
    )


def kernels_cover(body: BodyModel) -> bool:
    """Whether the compiled kernels know a body of this kind: skinned linearly, pose blend shapes
    linear in vec(R - I).

    Other bodies are fitted by `habitus.observe.body_markers.BodyMarkers`.
    """
    usual = body.pose_features == "rotations" and not body.shape_features
    return body.skinning == "lbs" and (body.posedirs is None or usual)


def _check(body: BodyModel, betas: Array, corners: np.ndarray) -> None:
    if body.skinning != "lbs":
        raise HabitusError(
            f"marker kernels skin linearly (lbs), this body wants {body.skinning!r}; take an lbs "
            "body"
        )
    if not kernels_cover(body):
        check_driven_by_rotations(body, "marker fits")
    if len(corners) == 0:
        raise HabitusError("the attachment has no marker; give at least one")
    if corners[0] < 0 or corners[-1] >= len(body.v_template):
        raise HabitusError(
            f"markers sit on vertex {corners[-1]}, but the body has {len(body.v_template)}; "
            "attach them to this body"
        )
    if len(betas) > body.shapedirs.shape[2]:
        raise HabitusError(
            f"got {len(betas)} betas, the body has {body.shapedirs.shape[2]}; use the body of "
            "these betas"
        )
    if any(parent >= joint for joint, parent in enumerate(body.parents)) or body.parents[0] >= 0:
        raise HabitusError(
            "joints must come after their parents and the root first; reorder the body's joints"
        )


def _trim(influences: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move each corner's non-zero weights to the front and cut the columns that none of them
    uses.
    """
    order = np.argsort(-np.abs(weights), axis=1, kind="stable")
    influences = np.take_along_axis(influences, order, 1)
    weights = np.take_along_axis(weights, order, 1)
    used = max(1, int((weights != 0).sum(axis=1).max()))
    influences = np.where(weights != 0, influences, influences[:, :1])
    return np.ascontiguousarray(influences[:, :used]), np.ascontiguousarray(weights[:, :used])
