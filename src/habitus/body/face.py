"""What a face does and who it is: named units with ARKit's names, and components of identity.

A unit moves skin, and may turn joints (jaw, eyes) besides: its rotation vectors, times its weight,
are added to those of the pose. Both are kept for the vertices that they move.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind, broadcast_shapes
from habitus.errors import HabitusError
from habitus.rotations import matrix_from_rotvec
from habitus.types import Array, ArrayLike


@dataclass(frozen=True, eq=False)
class Face:
    """U units and I components of identity over H of a body's vertices.

    ``unit_directions`` are metres at weight 1, ``identity_directions`` metres for one standard
    deviation. ``turns`` are rotation vectors (rad) of ``joints`` at weight 1.
    """

    vertices: Int[np.ndarray, " H"]
    unit_names: tuple[str, ...]
    unit_directions: Float[np.ndarray, "H 3 U"]
    joints: tuple[int, ...]
    turns: Float[np.ndarray, "U K 3"]
    identity_directions: Float[np.ndarray, "H 3 I"]

    def directions(self, count: int) -> Float[np.ndarray, "V 3 C"]:
        """Those of identity, then those of units, for all ``count`` vertices of the body."""
        both = np.concatenate([self.identity_directions, self.unit_directions], axis=2)
        table = np.zeros((count, 3, both.shape[2]))
        table[self.vertices] = both
        return table

    def scaled(self, scale: float) -> "Face":
        """That of a body which is larger as a whole."""
        return replace(
            self,
            unit_directions=scale * self.unit_directions,
            identity_directions=scale * self.identity_directions,
        )

    def joint_turns(self, joints: int) -> Float[np.ndarray, "U M"]:
        """Rotation vectors of all joints of a body, in rows of 3 J numbers."""
        table = np.zeros((len(self.unit_names), joints, 3))
        table[:, list(self.joints)] = self.turns
        return table.reshape(len(table), -1)

    def with_joints(
        self,
        kept: Mapping[int, int],
        rest: Float[np.ndarray, "V 3"],
        rest_joints: Float[np.ndarray, "J 3"],
        weights: Float[np.ndarray, "V J"],
    ) -> "Face":
        """The face of a body with fewer joints, ``kept`` old to new: what the others turned becomes
        straight motion of the vertices that they carried, exact at weights 0 and 1.

        ``rest``, ``rest_joints`` and skinning ``weights`` are those of the body before.
        """
        directions = self.unit_directions.copy()
        lost = [k for k, joint in enumerate(self.joints) if joint not in kept]
        for k in lost:
            share = weights[self.vertices, self.joints[k]]
            carried, turning = np.flatnonzero(share), np.flatnonzero(self.turns[:, k].any(-1))
            rows = np.ix_(carried, np.arange(3), turning)
            arm = (rest[self.vertices[carried]] - rest_joints[self.joints[k]])[..., None]
            turn = matrix_from_rotvec(self.turns[turning, k]) - np.eye(3)
            directions[rows] += np.einsum(
                "h,uij,hju->hiu", share[carried], turn, arm + self.unit_directions[rows]
            )
        stay = [k for k in range(len(self.joints)) if k not in lost]
        return replace(
            self,
            unit_directions=directions,
            joints=tuple(kept[self.joints[k]] for k in stay),
            turns=self.turns[:, stay],
        )


def read_face_weights(
    values: ArrayLike | Mapping[str, ArrayLike], kind: Kind, face: Face | None, body: str
) -> Float[Array, "*batch U"]:
    """Weights of all units, from those of all, or (*batch,) by the names of some; the others are
    zero.

    Raises HabitusError for a name that is no unit's, and for a body without units.
    """
    if face is None:
        raise HabitusError(f"{body} has no face units; load neutral, female or male")
    names = face.unit_names
    if not isinstance(values, Mapping):
        array = kind.array(values)
        if array.shape[-1:] != (len(names),):
            raise HabitusError(
                f"face has shape {tuple(array.shape)}; expected (*batch, {len(names)}) or weights "
                "by name"
            )
        return array
    if unknown := [name for name in values if name not in names]:
        near = get_close_matches(str(unknown[0]), names, cutoff=0.4) or names
        raise HabitusError(
            f"{body} has no face unit {unknown[0]!r}; did you mean {', '.join(near)}?"
        )
    named = {name: kind.array(value) for name, value in values.items()}
    batch = broadcast_shapes(*(value.shape for value in named.values()))
    rest = kind.zeros()
    return kind.xp.stack([kind.xp.broadcast_to(named.get(name, rest), batch) for name in names], -1)
