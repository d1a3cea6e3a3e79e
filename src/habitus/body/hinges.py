"""Hinge correctives: pose blend shapes of deep folds, which vec(R - I) cannot tell from shallow
ones.

About a hinge the entries of R - I span sin t and 1 - cos t only. A channel adds a weight that is
zero up to some angle and grows beyond it,

    w = clip(row . vec(R - I) - bias, 0, 1)^2,

and moves vertices by its directions, times 1 and times each of the first S shape coefficients:
folds begin at other angles in other people. ``posedirs`` of a body with hinges are the best ones
without them; what they hold of a channel, ``linear`` . vec(R - I), gives way to the channel, so
that a reader of SMPL's arrays alone loses no accuracy.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import constant, flatten, namespace, to_numpy
from habitus.body.pose_features import PoseFeatures, extended
from habitus.errors import HabitusError
from habitus.types import Array

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
        """Rows (C, 9 P) over the features of all P joints that drive pose blend shapes."""
        table = np.zeros((self.num_channels, len(drivers), ENTRIES))
        table[np.arange(self.num_channels), [drivers.index(j) for j in self.joint]] = rows
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
        """``posedirs`` less what they hold of the channels."""
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
