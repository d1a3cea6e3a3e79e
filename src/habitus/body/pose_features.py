"""What drives pose blend shapes: functions of each joint's rotation that are zero at rest, of all
joints but the root, as in SMPL, or of some, such as those that limbs twist about.

SMPL takes the entries of R - I (S 3, eq. 9). The others are those that thesis 5.6 reports as tried
(raw rotation vectors, low polynomials of them, sines and cosines) or leaves open (unit
quaternions). The same section asks for pose blend shapes that depend on shape too: `extended`
repeats the features, times each of the first shape coefficients.

Hinge correctives are pose blend shapes of deep folds, which vec(R - I) cannot tell from shallow
ones: about a hinge the entries of R - I span sin t and 1 - cos t only. A channel adds a weight that
is zero up to some angle and grows beyond it,

    w = clip(row . vec(R - I) - bias, 0, 1)^2,

and moves vertices by its directions, times 1 and times each of the first S shape coefficients:
folds begin at other angles in other people. ``posedirs`` of a body with hinges are the best ones
without them; what they hold of a channel, ``linear`` . vec(R - I), gives way to the channel, so
that a reader of SMPL's arrays alone loses no accuracy.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import constant, cross, eye, flatten, namespace, to_numpy, unbind
from habitus.errors import HabitusError
from habitus.rotations import (
    cross_matrix,
    left_jacobian,
    matrix_from_rotvec,
    quaternion_from_rotvec,
)
from habitus.types import Array


@dataclass(frozen=True)
class PoseFeatures:
    """A kind of features: k numbers a joint, and how they change.

    ``value`` takes rotation vectors (*batch, J, 3; rad) to features (*batch, J, k), zero at rest.
    ``slope`` takes them to derivatives (*batch, J, k, 3) with respect to a small turn from the
    left, R -> exp([d]x) R, d in rad. Both are differentiable. ``from_matrix`` is ``value`` from
    rotation matrices (*batch, J, 3, 3), where that is cheaper.
    """

    name: str
    per_joint: int
    value: Callable[[Array], Array]
    slope: Callable[[Array], Array]
    from_matrix: Callable[[Array], Array] | None = None

    def count(self, joints: int, shape_features: int = 0) -> int:
        """F: features of a body, whose root drives nothing: (J - 1) k (1 + s)."""
        return (joints - 1) * self.per_joint * (1 + shape_features)

    def of_pose(
        self,
        pose: Float[Array, "*batch J 3"],
        rotations: Float[Array, "*batch J 3 3"],
        joints: list[int] | None = None,
    ) -> Float[Array, "*batch F"]:
        """Features of some joints (None: all but the root), one by one; ``rotations`` are those of
        ``pose`` (rad).
        """
        some = slice(1, None) if joints in (None, list(range(1, pose.shape[-2]))) else joints
        if self.from_matrix is not None:
            return flatten(self.from_matrix(rotations[..., some, :, :]), -2)
        return flatten(self.value(pose[..., some, :]), -2)


def find_pose_features(name: str) -> PoseFeatures:
    """The features of that name; HabitusError where there are none."""
    if name not in POSE_FEATURES:
        raise HabitusError(
            f"pose features are {name!r}; expected one of {', '.join(POSE_FEATURES)}"
        )
    return POSE_FEATURES[name]


def check_driven_by_rotations(body: Any, user: str, hinges: bool = False) -> None:
    """HabitusError unless a body's pose blend shapes, if any, are linear in vec(R - I) alone, which
    ``user`` needs, or with ``hinges`` in these and the channels of hinges.
    """
    name = getattr(body, "pose_features", "rotations")
    shapes = getattr(body, "shape_features", 0)
    folds = not hinges and getattr(body, "hinges", None) is not None
    if body.posedirs is not None and (name != "rotations" or shapes or folds):
        products = f" times {shapes} shape coefficients" if shapes else ""
        products += " and hinges" if folds else ""
        raise HabitusError(
            f"pose blend shapes driven by {name!r}{products}; {user} need 'rotations' alone: take "
            "another body, "
            "or replace(body, posedirs=None, hinges=None)"
        )


def extended(
    feature: Float[Array, "*#batch F"], betas: Float[Array, "*#batch B"], shape_features: int
) -> Float[Array, "*#batch G"]:
    """[f, beta_1 f, ..., beta_s f] with s = ``shape_features``: pose blend shapes linear in shape
    (thesis 5.6).

    The features themselves where s is 0; ``betas`` may be longer than s. G is F (1 + s).
    """
    if not shape_features:
        return feature
    scaled = betas[..., :shape_features, None] * feature[..., None, :]
    xp = namespace(scaled)
    alone = xp.broadcast_to(feature, (*scaled.shape[:-2], feature.shape[-1]))
    return xp.concatenate([alone, flatten(scaled, -2)], -1)


def _entries(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 9"]:
    """vec(R - I), rows first (S 3, eq. 9)."""
    return flatten(matrix - eye(3, matrix), -2)


def _entries_slope(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 9 3"]:
    return flatten(
        cross_matrix(eye(3, rotvec)) @ matrix_from_rotvec(rotvec)[..., None, :, :], -2
    ).mT


def _angles_slope(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """The inverse of the left Jacobian, by cofactors; singular at an angle of 2 pi."""
    x, y, z = unbind(left_jacobian(rotvec))
    cofactors = namespace(rotvec).stack([cross(y, z), cross(z, x), cross(x, y)], -2)
    return cofactors / (cofactors[..., 0, :] * x).sum(-1)[..., None, None]


def _sin_cos(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 6"]:
    xp = namespace(rotvec)
    return xp.concatenate([xp.sin(rotvec), -2 * xp.sin(rotvec / 2) ** 2], -1)


def _sin_cos_slope(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 6 3"]:
    xp = namespace(rotvec)
    turned = _angles_slope(rotvec)
    return xp.concatenate(
        [xp.cos(rotvec)[..., None] * turned, -xp.sin(rotvec)[..., None] * turned], -2
    )


def _near_quaternion(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """The unit quaternion whose real part is not negative."""
    quaternion = quaternion_from_rotvec(rotvec)
    return namespace(rotvec).where(quaternion[..., :1] < 0, -quaternion, quaternion)


def _quaternions(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    quaternion = _near_quaternion(rotvec)
    return namespace(rotvec).concatenate([quaternion[..., :1] - 1, quaternion[..., 1:]], -1)


def _quaternions_slope(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4 3"]:
    """Half the product of (0, d) and the quaternion: d w = -d . v / 2, d v = (w d + d x v) / 2."""
    quaternion = _near_quaternion(rotvec)
    w = quaternion[..., :1]
    v = quaternion[..., 1:]
    by_vector = w[..., None] * eye(3, rotvec) - cross_matrix(v)
    return namespace(rotvec).concatenate([-v[..., None, :], by_vector], -2) / 2


_FIRST = [0, 1, 2, 0, 0, 1]
_SECOND = [0, 1, 2, 1, 2, 2]


def _polynomials(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 9"]:
    """x, y, z, xx, yy, zz, xy, xz, yz."""
    return namespace(rotvec).concatenate([rotvec, rotvec[..., _FIRST] * rotvec[..., _SECOND]], -1)


def _polynomials_slope(rotvec: Float[Array, "*batch 3"]) -> Float[Array, "*batch 9 3"]:
    turned = _angles_slope(rotvec)
    first = rotvec[..., _FIRST, None]
    second = rotvec[..., _SECOND, None]
    return namespace(rotvec).concatenate(
        [turned, first * turned[..., _SECOND, :] + second * turned[..., _FIRST, :]], -2
    )


def _table(*kinds: PoseFeatures) -> Mapping[str, PoseFeatures]:
    return MappingProxyType({kind.name: kind for kind in kinds})


POSE_FEATURES: Mapping[str, PoseFeatures] = _table(
    PoseFeatures(
        "rotations",
        9,
        lambda rotvec: _entries(matrix_from_rotvec(rotvec)),
        _entries_slope,
        _entries,
    ),
    PoseFeatures("angles", 3, lambda rotvec: rotvec, _angles_slope),
    PoseFeatures("sin_cos", 6, _sin_cos, _sin_cos_slope),
    PoseFeatures("quaternions", 4, _quaternions, _quaternions_slope),
    PoseFeatures("polynomials", 9, _polynomials, _polynomials_slope),
)
"""Features by name; "rotations" is SMPL's vec(R - I) and alone smooth over all rotations.

"angles", "sin_cos" and "polynomials" read the rotation vector as given. As a function of the
rotation it jumps to its far side at an angle of pi, and the features with it; their slopes hold on
either side and grow without bound towards an angle of 2 pi, so keep vectors wrapped
(`habitus.rotations.rotvec_from_matrix`). "quaternions", with a real part that is not negative, are
the same for both vectors of a rotation, and change sign at an angle of pi.
"""


def check_pose_shapes(
    posedirs: np.ndarray | None,
    features: PoseFeatures,
    joints: int,
    betas: int,
    shape_features: int,
    pose_joints: tuple[int, ...] | None = None,
) -> None:
    """HabitusError where pose blend shapes do not fit the joints and shape coefficients that drive
    them.
    """
    if not 0 <= shape_features <= betas:
        raise HabitusError(
            f"shape_features is {shape_features}; expected 0 to {betas} shape coefficients"
        )
    if pose_joints is not None and not (
        set(pose_joints) <= set(range(1, joints)) and _differ(pose_joints)
    ):
        raise HabitusError(
            f"pose_joints are {pose_joints}; expected different joints from 1 to {joints - 1}"
        )
    drivers = joints - 1 if pose_joints is None else len(pose_joints)
    count = features.count(1 + drivers, shape_features)
    if posedirs is not None and posedirs.shape[-1] != count:
        raise HabitusError(
            f"posedirs has {posedirs.shape[-1]} directions; expected {count}: {features.name!r} "
            f"of {drivers} "
            f"joints, with {shape_features} shape_features"
        )


def _differ(numbers: tuple[int, ...]) -> bool:
    return len(set(numbers)) == len(numbers)


def of_joints(
    posedirs: Float[np.ndarray, "N 3 F"],
    per_joint: int,
    drivers: tuple[int, ...],
    chosen: tuple[int, ...],
    shape_features: int = 0,
) -> Float[np.ndarray, "N 3 G"]:
    """The same pose blend shapes for other driving joints: zeros for joints that had none, left out
    for others' own.
    """
    if drivers == chosen:
        return posedirs
    blocks = posedirs.reshape(*posedirs.shape[:2], 1 + shape_features, len(drivers), per_joint)
    columns = np.zeros((*blocks.shape[:3], len(chosen), per_joint), posedirs.dtype)
    both = [(chosen.index(joint), k) for k, joint in enumerate(drivers) if joint in chosen]
    if both:
        there, here = map(list, zip(*both, strict=True))
        columns[..., there, :] = blocks[..., here, :]
    return columns.reshape(*posedirs.shape[:2], -1)


ENTRIES = 9
"""Entries of R - I of a joint."""


@dataclass(frozen=True, eq=False)
class Hinges:
    """C channels: the joint that drives each, its row and bias, the linear stand-in that
    ``posedirs`` hold of it, and its directions (m), for everybody and times the first S betas.
    """

    joint: Int[np.ndarray, " C"]
    rows: Float[np.ndarray, "C 9"]
    bias: Float[np.ndarray, " C"]
    linear: Float[np.ndarray, "C 9"]
    directions: Float[np.ndarray, "V 3 C S1"]

    def __post_init__(self):
        for field in fields(self):
            dtype = np.int64 if field.name == "joint" else np.float64
            object.__setattr__(self, field.name, to_numpy(getattr(self, field.name), dtype))

    @property
    def num_channels(self) -> int:
        """C."""
        return len(self.joint)

    @property
    def num_shapes(self) -> int:
        """S: shape coefficients that the channels are multiplied with."""
        return self.directions.shape[3] - 1

    @property
    def count(self) -> int:
        """C (1 + S): directions in all."""
        return self.directions.shape[2] * self.directions.shape[3]

    @property
    def padding(self) -> int:
        """Zeros behind them, up to a multiple of `ENTRIES`: kernels take features by blocks."""
        return -self.count % ENTRIES

    def rows_of(self, drivers: list[int], rows: Float[np.ndarray, "C 9"]) -> np.ndarray:
        """Rows (C, 9 P) over the features of P joints that drive pose blend shapes; zeros for the
        channels of other joints.
        """
        table = np.zeros((self.num_channels, len(drivers), ENTRIES))
        for channel, joint in enumerate(self.joint):
            if joint in drivers:
                table[channel, drivers.index(joint)] = rows[channel]
        return table.reshape(self.num_channels, -1)

    def driven(self, feature: Float[Array, "*batch F"], drivers: list[int]) -> Array:
        """row . vec(R - I) - bias, cut to 0 and 1 (*batch, C); ``feature`` are the entries of R - I
        of the ``drivers``.
        """
        rows = constant(self.rows_of(drivers, self.rows), feature)
        xp = namespace(feature)
        return xp.clip(feature @ rows.T - constant(self.bias, feature), 0.0, 1.0)

    def coefficients(
        self,
        feature: Float[Array, "*#batch F"],
        betas: Float[Array, "*#batch B"],
        drivers: list[int],
    ) -> Float[Array, "*#batch D"]:
        """What the D = C (1 + S) directions are multiplied with: w and w beta_s, channel by
        channel.
        """
        weight = self.driven(feature, drivers)[..., None] ** 2
        if not self.num_shapes:
            return weight[..., 0]
        scaled = weight * betas[..., None, : self.num_shapes]
        xp = namespace(scaled)
        alone = xp.broadcast_to(weight, (*scaled.shape[:-1], 1))
        return flatten(xp.concatenate([alone, scaled], -1), -2)

    def without_linear(
        self, posedirs: Float[np.ndarray, "V 3 F"], drivers: list[int]
    ) -> Float[np.ndarray, "V 3 F"]:
        """``posedirs`` of some joints less what they hold of the channels."""
        rows = self.rows_of(drivers, self.linear)
        used = rows.any(axis=0)
        plain = posedirs.copy()
        # A product of matrices: numpy is ten times slower with a stride between the directions.
        held = self.directions[..., 0].reshape(-1, self.num_channels) @ rows[:, used]
        plain[..., used] -= held.reshape(*posedirs.shape[:2], -1)
        return plain

    def for_person(self, betas: Float[np.ndarray, " B"]) -> "Hinges":
        """The channels of one person, S = 0, over ``posedirs`` that are `without_linear`."""
        factors = np.concatenate([[1.0], betas[: self.num_shapes]])
        directions = (self.directions @ factors)[..., None]
        return replace(self, linear=np.zeros_like(self.linear), directions=directions)

    def with_shapes(self, count: int) -> "Hinges":
        """The channels without factors of betas from number ``count`` on."""
        return replace(self, directions=self.directions[..., : 1 + count])

    def scaled(self, scale: float) -> "Hinges":
        """The same channels on a body of other size."""
        return replace(self, directions=scale * self.directions)

    def with_joints(self, kept: dict[int, int]) -> "Hinges | None":
        """The channels of the joints that are ``kept``, by their new numbers; None where none
        is.
        """
        here = [k for k, joint in enumerate(self.joint) if joint in kept]
        if not here:
            return None
        return Hinges(
            np.array([kept[joint] for joint in self.joint[here]]),
            self.rows[here],
            self.bias[here],
            self.linear[here],
            self.directions[:, :, here],
        )


NO_HINGES = Hinges(
    np.zeros(0, np.int64),
    np.zeros((0, ENTRIES)),
    np.zeros(0),
    np.zeros((0, ENTRIES)),
    np.zeros((0, 3, 0, 1)),
)
"""No channels, of any body."""


def pose_coefficients(
    features: PoseFeatures,
    hinges: Hinges | None,
    shape_features: int,
    drivers: list[int],
    pose: Float[Array, "*batch J 3"],
    rotations: Float[Array, "*batch J 3 3"],
    betas: Float[Array, "*#batch B"],
) -> Float[Array, "*batch G"]:
    """What a body's pose directions are multiplied with: its pose features, times shape where they
    depend on it, its hinges' weights, and zeros up to a block of nine.
    """
    feature = features.of_pose(pose, rotations, drivers)
    if hinges is None:
        return extended(feature, betas, shape_features)
    folds = hinges.coefficients(feature, betas, drivers)
    xp = namespace(folds)
    batch = folds.shape[:-1]
    none = constant(np.zeros((*batch, hinges.padding)), folds)
    return xp.concatenate([xp.broadcast_to(feature, (*batch, feature.shape[-1])), folds, none], -1)


def check_hinges(hinges: Hinges | None, vertices: int, drivers: list[int], betas: int) -> None:
    """HabitusError where channels do not fit the body's vertices, driving joints and betas."""
    if hinges is None:
        return
    if len(hinges.directions) != vertices:
        raise HabitusError(
            f"hinge channels of {len(hinges.directions)} vertices; expected {vertices}"
        )
    if strange := sorted(set(hinges.joint.tolist()) - set(drivers)):
        raise HabitusError(
            f"hinge channels of joints {strange}, which drive no pose blend shapes; expected some "
            f"of {drivers}"
        )
    if hinges.num_shapes > betas:
        raise HabitusError(
            f"hinge channels times {hinges.num_shapes} shape coefficients; expected {betas} at most"
        )
