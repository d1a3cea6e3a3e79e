"""The rig shared by all people, and one person's rest surface and joints (S 4.1)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from habitus.body.skinning import ancestors


# Beside `BodyModel`, as training poses people by their own rest surfaces and joints, before there
# is a shape space or a joint regressor, without which there is no body.
@dataclass(frozen=True, eq=False)
class Rig:
    """Skinning weights W and pose blend shapes P, and the tree, skinning and pose features that
    they belong to.

    ``index`` and ``value`` hold the K joints of each vertex and their weights. The last axis of
    ``posedirs`` (m) is that of ``BodyModel.posedirs``: blocks of (J - 1) k features, the first for
    everybody, one more for each of the ``shape_features`` numbers that describe a person. Without
    pose blend shapes it is None.
    """

    parents: tuple[int, ...]
    skinning: str
    pose_features: str
    shape_features: int
    index: Int[np.ndarray, "V K"]
    value: Float[np.ndarray, "V K"]
    posedirs: Float[np.ndarray, "V 3 F"] | None

    @property
    def num_vertices(self) -> int:
        """V."""
        return len(self.index)

    @property
    def num_joints(self) -> int:
        """J."""
        return len(self.parents)

    @cached_property
    def weights(self) -> Float[np.ndarray, "V J"]:
        """The skinning weights as a dense table."""
        dense = np.zeros((self.num_vertices, self.num_joints))
        np.add.at(dense, (np.arange(self.num_vertices)[:, None], self.index), self.value)
        return dense

    @cached_property
    def strongest(self) -> Int[np.ndarray, " V"]:
        """Each vertex' strongest joint."""
        return self.index[np.arange(self.num_vertices), self.value.argmax(1)]

    @cached_property
    def parent_index(self) -> Int[np.ndarray, " J"]:
        """Parents as an array; -1 for the root."""
        return np.array(self.parents, dtype=np.int64)

    def posedirs_for(
        self, descriptor: Float[np.ndarray, " s"]
    ) -> Float[np.ndarray, "V 3 G"] | None:
        """The pose blend shapes of a person: the blocks summed with 1 and the person's
        descriptor.
        """
        if self.posedirs is None or self.shape_features == 0:
            return self.posedirs
        blocks = self.posedirs.reshape(self.num_vertices, 3, 1 + self.shape_features, -1)
        return np.tensordot(np.concatenate([[1.0], descriptor]), blocks, (0, 2))


@dataclass(frozen=True, eq=False)
class RestPerson:
    """A person's rest surface and rest joints (m), and the numbers that shape-dependent blend
    shapes go by.
    """

    template: Float[np.ndarray, "V 3"]
    joints: Float[np.ndarray, "J 3"]
    descriptor: Float[np.ndarray, " s"]


def influences(weights: Float[np.ndarray, "V J"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """The ``count`` strongest joints of each vertex, strongest first, and their weights scaled to
    sum to one.
    """
    count = min(count, weights.shape[1])
    index = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    value = np.take_along_axis(weights, index, 1)
    return index.astype(np.int64), value / value.sum(1, keepdims=True)


def kinship(parents: tuple[int, ...]) -> Float[np.ndarray, "J J"]:
    """Number of bones between any two joints of the tree."""
    chains = ancestors(parents)
    shared = np.array([[len(set(a) & set(b)) for b in chains] for a in chains])
    depth = np.array([len(chain) for chain in chains])
    return (depth[:, None] + depth[None] - 2 * shared).astype(float)
