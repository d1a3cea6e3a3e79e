"""Models that can be posed and fitted to registrations, to be compared with each other (S 5.1)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import flatten
from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.evaluate.surface_fit import Columns, Fit, FittedToSurfaces, Surface

BLOCK = 1024
"""Vertices whose derivatives are made at once."""


class Posable(Protocol):
    """A model with shape and pose that can be fitted to a registration and timed."""

    @property
    def name(self) -> str:
        """Name in tables and plots."""
        ...

    @property
    def num_betas(self) -> int:
        """Number of shape coefficients."""
        ...

    def fit(
        self,
        target: Float[np.ndarray, "V 3"],
        *,
        num_betas: int,
        betas: Float[np.ndarray, " B"] | None = None,
        start: Fit | None = None,
        weights: Float[np.ndarray, " V"] | None = None,
    ) -> Fit:
        """The least squares of vertex distance (m) over pose, trans and shape, or with the shape
        ``betas`` fixed. weights: of the squared distances, 0 where a vertex was not observed.
        """
        ...

    def forward(self, num_betas: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The function (betas, pose) -> vertices with that many coefficients; with 0 the mean shape
        is made once.
        """
        ...


class ComparedModel(Posable, Surface, Protocol):
    """A model of triangles to be compared with others on registrations (`jobs.evaluate`): a
    `PosableBody`, or a baseline of another kind.
    """

    @property
    def kind(self) -> str:
        """What tables call such models, "blend shapes" say."""
        ...

    @property
    def template(self) -> Float[np.ndarray, "V 3"]:
        """Vertices at rest (m)."""
        ...

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Triangles."""
        ...

    @property
    def shape_directions(self) -> Float[np.ndarray, "B ..."]:
        """What one standard deviation of each shape coefficient adds."""
        ...

    @property
    def shape_variances(self) -> Float[np.ndarray, " S"] | None:
        """Variances along all shape directions of the training, where the model keeps them."""
        ...


@dataclass(frozen=True, eq=False)
class PosableBody(FittedToSurfaces):
    """A BodyModel as something to be fitted."""

    body: BodyModel
    label: str = ""

    @property
    def kind(self) -> str:
        """What tables call it."""
        return "blend shapes"

    @property
    def name(self) -> str:
        """The label, or the body's name."""
        return self.label or self.body.name

    @property
    def num_betas(self) -> int:
        """B."""
        return self.body.num_betas

    @property
    def parents(self) -> tuple[int, ...]:
        """The tree of joints."""
        return self.body.parents

    @property
    def influence(self) -> Float[np.ndarray, "V J"]:
        """Skinning weights."""
        return self.body.skinning_weights

    @property
    def template(self) -> Float[np.ndarray, "V 3"]:
        """Vertices at rest (m)."""
        return self.body.v_template

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Triangles."""
        return self.body.faces

    @property
    def shape_directions(self) -> Float[np.ndarray, "B C"]:
        """What one standard deviation of each shape coefficient adds to all coordinates (m)."""
        return self.body.shapedirs.reshape(-1, self.num_betas).T

    @property
    def shape_variances(self) -> Float[np.ndarray, " S"] | None:
        """Those that the body's file keeps, of all shape directions of its training (m^2)."""
        return self.body.extras.get("shape_variances")

    def surface(
        self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"]
    ) -> Float[np.ndarray, "V 3"]:
        """Vertices (m) of the first so many shape coefficients and of a pose (rotation vectors,
        rad).
        """
        return self.body(betas, pose).vertices

    def columns(
        self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"], by_betas: bool
    ) -> Iterator[Columns]:
        """Vertices and their exact derivatives, ``BLOCK`` vertices at a time."""
        count = len(betas) if by_betas else 0
        for first in range(0, self.body.num_vertices, BLOCK):
            ids = np.arange(first, min(first + BLOCK, self.body.num_vertices))
            jacobian = surface_jacobian(self.body, betas, pose, vertices=ids)
            parts = [jacobian.vertices_betas[..., :count], flatten(jacobian.vertices_pose, -2)]
            yield (
                slice(first, first + len(ids)),
                jacobian.surface.vertices,
                np.concatenate(parts, -1),
            )

    def forward(self, num_betas: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The function (betas, pose) -> vertices with that many coefficients; with 0 the mean shape
        is made once.
        """
        if num_betas == 0:
            prepared = self.body.prepare()
            return lambda _, pose: prepared(pose).vertices
        body = self.body.with_betas(max(num_betas, self.body.shape_features))
        return lambda betas, pose: body(betas, pose).vertices


def without_pose_shapes(body: BodyModel) -> BodyModel:
    """The same body as plain blend skinning: what S 5.1 calls LBS, "the SMPL-LBS model with no pose
    blend shapes".
    """
    return replace(body, posedirs=None, hinges=None)
