"""A body's arrays in one kind (library, dtype, device), laid out for speed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind
from habitus.body.blend_shapes import flat_rows
from habitus.body.skinning import Influences
from habitus.types import Array


@dataclass(frozen=True)
class RestSkeleton:
    """The template's joints and how shape moves them, and the body's faces, in one kind."""

    template: Float[Array, "J 3"]
    shapedirs: Float[Array, "J 3 B"]
    faces: Int[Array, "T 3"]

    def rest_joints(self, betas: Float[Array, "*batch B"]) -> Float[Array, "*batch J 3"]:
        """Joints (m) of shaped rest surfaces (S 3, eq. 10)."""
        return self.template + (self.shapedirs @ betas[..., None, :, None])[..., 0]


@dataclass(frozen=True)
class VertexRows:
    """The arrays of some vertices, laid out for speed: bases as rows (K, 3N), coordinates before vertices."""

    template: Float[Array, " M"]
    blend_shapes: Float[Array, "K M"]
    """The shape's directions, then those of the pose."""
    num_betas: int
    influences: Influences

    @property
    def shapedirs(self) -> Float[Array, "B M"]:
        """What shape coefficients add."""
        return self.blend_shapes[: self.num_betas]

    @property
    def posedirs(self) -> Float[Array, "F M"] | None:
        """What pose features add, where the body has pose blend shapes."""
        return self.blend_shapes[self.num_betas :] if len(self.blend_shapes) > self.num_betas else None


def vertex_rows(
    kind: Kind,
    ids: Int[np.ndarray, " N"] | slice,
    v_template: Float[np.ndarray, "V 3"],
    shapedirs: Float[np.ndarray, "V 3 B"],
    posedirs: Float[np.ndarray, "V 3 F"] | None,
    skinning_weights: Float[np.ndarray, "V J"],
    skinning_index: Int[np.ndarray, "V K"],
    skinning_value: Float[np.ndarray, "V K"],
) -> VertexRows:
    """A body's arrays for some of its vertices."""
    dense = np.ascontiguousarray(skinning_weights[ids].T)
    bases = shapedirs[ids] if posedirs is None else np.concatenate([shapedirs[ids], posedirs[ids]], axis=2)
    return VertexRows(
        template=kind.array(v_template[ids].T.flatten()),
        blend_shapes=kind.array(flat_rows(bases)),
        num_betas=shapedirs.shape[2],
        influences=Influences(kind.array(dense), kind.index(skinning_index[ids]), kind.array(skinning_value[ids])),
    )
