"""What drives pose blend shapes: functions of each joint's rotation that are zero at rest.

SMPL takes the entries of R - I (S 3, eq. 9). The others are those that thesis 5.6 reports as tried (raw rotation
vectors, low polynomials of them, sines and cosines) or leaves open (unit quaternions). The same section asks for pose
blend shapes that depend on shape too: `extended` repeats the features, times each of the first shape coefficients.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from habitus.errors import HabitusError
from habitus.rotations import cross_matrix, left_jacobian, matrix_from_rotvec, quaternion_from_rotvec


@dataclass(frozen=True)
class PoseFeatures:
    """A kind of features: k numbers a joint, and how they change.

    ``value`` takes rotation vectors (*batch, J, 3; rad) to features (*batch, J, k), zero at rest. ``slope`` takes them
    to derivatives (*batch, J, k, 3) with respect to a small turn from the left, R -> exp([d]x) R, d in rad. Both are
    differentiable. ``from_matrix`` is ``value`` from rotation matrices (*batch, J, 3, 3), where that is cheaper.
    """

    name: str
    per_joint: int
    value: Callable[[Tensor], Tensor]
    slope: Callable[[Tensor], Tensor]
    from_matrix: Callable[[Tensor], Tensor] | None = None

    def count(self, joints: int, shape_features: int = 0) -> int:
        """F: features of a body, whose root drives nothing: (J - 1) k (1 + s)."""
        return (joints - 1) * self.per_joint * (1 + shape_features)

    def of_pose(
        self, pose: Float[Tensor, "*batch J 3"], rotations: Float[Tensor, "*batch J 3 3"]
    ) -> Float[Tensor, "*batch F"]:
        """All joints' features but the root's, joint by joint; ``rotations`` are those of ``pose`` (rad)."""
        if self.from_matrix is not None:
            return self.from_matrix(rotations[..., 1:, :, :]).flatten(-2)
        return self.value(pose[..., 1:, :]).flatten(-2)


def find_pose_features(name: str) -> PoseFeatures:
    """The features of that name; HabitusError where there are none."""
    if name not in POSE_FEATURES:
        raise HabitusError(f"pose features are {name!r}; expected one of {', '.join(POSE_FEATURES)}")
    return POSE_FEATURES[name]


def check_driven_by_rotations(body: Any, user: str) -> None:
    """HabitusError unless a body's pose blend shapes, if any, are linear in vec(R - I) alone, which ``user`` needs."""
    name, shapes = getattr(body, "pose_features", "rotations"), getattr(body, "shape_features", 0)
    if body.posedirs is not None and (name != "rotations" or shapes):
        products = f" times {shapes} shape coefficients" if shapes else ""
        raise HabitusError(
            f"pose blend shapes driven by {name!r}{products}; {user} need 'rotations' alone: take another body, "
            "or replace(body, posedirs=None)"
        )


def extended(
    feature: Float[Tensor, "*#batch F"], betas: Float[Tensor, "*#batch B"], shape_features: int
) -> Float[Tensor, "*#batch G"]:
    """[f, beta_1 f, ..., beta_s f] with s = ``shape_features``: pose blend shapes linear in shape (thesis 5.6).

    The features themselves where s is 0; ``betas`` may be longer than s. G is F (1 + s).
    """
    if not shape_features:
        return feature
    scaled = betas[..., :shape_features, None] * feature[..., None, :]
    return torch.cat([feature.expand(*scaled.shape[:-2], -1), scaled.flatten(-2)], -1)


def _entries(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 9"]:
    """vec(R - I), rows first (S 3, eq. 9)."""
    return (matrix - torch.eye(3, dtype=matrix.dtype, device=matrix.device)).flatten(-2)


def _entries_slope(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9 3"]:
    units = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return (cross_matrix(units) @ matrix_from_rotvec(rotvec)[..., None, :, :]).flatten(-2).mT


def _angles_slope(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The inverse of the left Jacobian, by cofactors; singular at an angle of 2 pi."""
    x, y, z = left_jacobian(rotvec).unbind(-1)
    cofactors = torch.stack([torch.linalg.cross(y, z), torch.linalg.cross(z, x), torch.linalg.cross(x, y)], -2)
    return cofactors / (cofactors[..., 0, :] * x).sum(-1)[..., None, None]


def _sin_cos(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 6"]:
    return torch.cat([torch.sin(rotvec), -2 * torch.sin(rotvec / 2) ** 2], -1)


def _sin_cos_slope(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 6 3"]:
    turned = _angles_slope(rotvec)
    return torch.cat([torch.cos(rotvec)[..., None] * turned, -torch.sin(rotvec)[..., None] * turned], -2)


def _near_quaternion(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """The unit quaternion whose real part is not negative."""
    quaternion = quaternion_from_rotvec(rotvec)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def _quaternions(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    quaternion = _near_quaternion(rotvec)
    return torch.cat([quaternion[..., :1] - 1, quaternion[..., 1:]], -1)


def _quaternions_slope(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 3"]:
    """Half the product of (0, d) and the quaternion: d w = -d . v / 2, d v = (w d + d x v) / 2."""
    w, v = _near_quaternion(rotvec).split([1, 3], -1)
    eye = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return torch.cat([-v[..., None, :], w[..., None] * eye - cross_matrix(v)], -2) / 2


_FIRST, _SECOND = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]


def _polynomials(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """x, y, z, xx, yy, zz, xy, xz, yz."""
    return torch.cat([rotvec, rotvec[..., _FIRST] * rotvec[..., _SECOND]], -1)


def _polynomials_slope(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9 3"]:
    turned = _angles_slope(rotvec)
    first, second = rotvec[..., _FIRST, None], rotvec[..., _SECOND, None]
    return torch.cat([turned, first * turned[..., _SECOND, :] + second * turned[..., _FIRST, :]], -2)


def _table(*kinds: PoseFeatures) -> Mapping[str, PoseFeatures]:
    return MappingProxyType({kind.name: kind for kind in kinds})


POSE_FEATURES: Mapping[str, PoseFeatures] = _table(
    PoseFeatures("rotations", 9, lambda rotvec: _entries(matrix_from_rotvec(rotvec)), _entries_slope, _entries),
    PoseFeatures("angles", 3, lambda rotvec: rotvec, _angles_slope),
    PoseFeatures("sin_cos", 6, _sin_cos, _sin_cos_slope),
    PoseFeatures("quaternions", 4, _quaternions, _quaternions_slope),
    PoseFeatures("polynomials", 9, _polynomials, _polynomials_slope),
)
"""Features by name; "rotations" is SMPL's vec(R - I) and alone smooth over all rotations.

"angles", "sin_cos" and "polynomials" read the rotation vector as given. As a function of the rotation it jumps to its
far side at an angle of pi, and the features with it; their slopes hold on either side and grow without bound towards an
angle of 2 pi, so keep vectors wrapped (`habitus.rotations.rotvec_from_matrix`). "quaternions", with a real part that is
not negative, are the same for both vectors of a rotation, and change sign at an angle of pi.
"""
