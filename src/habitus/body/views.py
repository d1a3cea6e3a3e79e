"""A body's arrays in one kind (library, dtype, device), laid out for speed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind
from habitus.body.blend_shapes import flat_rows
from habitus.body.local_shapes import LocalShapes, local_shapes
from habitus.body.skinning import Influences
from habitus.types import Array


@dataclass(frozen=True)
class RestSkeleton:
    """The template's joints and how shape moves them, and the body's faces, in one kind."""

    template: Float[Array, "J 3"]
    directions: Float[Array, "J 3 C"]
    """By shape coefficients, then by those of the expression; by those of the dynamics not at all.
    """
    faces: Int[Array, "T 3"]

    def rest_joints(self, coefficients: Float[Array, "*batch C"]) -> Float[Array, "*batch J 3"]:
        """Joints (m) of shaped rest surfaces (S 3, eq. 10); the last coefficients may be left
        out.
        """
        directions = self.directions[..., : coefficients.shape[-1]]
        return self.template + (directions @ coefficients[..., None, :, None])[..., 0]


@dataclass(frozen=True)
class VertexRows:
    """The arrays of some vertices, laid out for speed: bases as rows (K, 3N), coordinates before
    vertices.
    """

    template: Float[Array, " M"]
    blend_shapes: Float[Array, "K M"]
    """The directions of shape, then, if asked for, those of expression and dynamics, then those of
    the pose.
    """
    num_shapes: int
    """How many there are before those of the pose."""
    influences: Influences
    local: LocalShapes | None = None
    """Those of the pose once more, without their zeros, where it pays to leave these out."""

    @property
    def shapedirs(self) -> Float[Array, "C M"]:
        """What the coefficients of shape, expression and dynamics add."""
        return self.blend_shapes[: self.num_shapes]

    @property
    def posedirs(self) -> Float[Array, "F M"] | None:
        """What pose features add, where the body has pose blend shapes."""
        return (
            self.blend_shapes[self.num_shapes :]
            if len(self.blend_shapes) > self.num_shapes
            else None
        )


def vertex_rows(
    kind: Kind,
    ids: Int[np.ndarray, " N"] | slice,
    v_template: Float[np.ndarray, "V 3"],
    directions: Sequence[Float[np.ndarray, "V 3 _"]],
    posedirs: Float[np.ndarray, "V 3 F"] | None,
    skinning_weights: Float[np.ndarray, "V J"],
    skinning_index: Int[np.ndarray, "V K"],
    skinning_value: Float[np.ndarray, "V K"],
    driven: tuple[int, int] = (0, 1),
) -> VertexRows:
    """A body's arrays for some of its vertices; ``directions`` are those of shape and, if they
    count, others.

    ``driven``: how many features a joint has, and in how many blocks.
    """
    dense = np.ascontiguousarray(skinning_weights[ids].T)
    bases = np.concatenate(
        [base[ids] for base in (*directions, posedirs) if base is not None], axis=2
    )
    local = local_shapes(None if posedirs is None else posedirs[ids], *driven)
    if local is not None:
        local = replace(local, value=local.value.astype(kind.compiled))
    return VertexRows(
        template=kind.array(v_template[ids].T.flatten()),
        blend_shapes=kind.array(flat_rows(bases)),
        num_shapes=sum(base.shape[2] for base in directions),
        influences=Influences(
            kind.array(dense), kind.index(skinning_index[ids]), kind.array(skinning_value[ids])
        ),
        local=local,
    )
