"""Models that can be posed and fitted to registrations, to be compared with each other (S 5.1)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float

from habitus.arrays import flatten
from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.evaluate.surface_fit import Columns, Fit, FittedToSurfaces

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
    ) -> Fit:
        """The least squares of vertex distance (m) over pose, trans and shape, or with the shape
        ``betas`` fixed.
        """
        ...

    def forward(self, num_betas: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The function (betas, pose) -> vertices with that many coefficients; with 0 the mean shape
        is made once.
        """
        ...


@dataclass(frozen=True, eq=False)
class PosableBody(FittedToSurfaces):
    """A BodyModel as something to be fitted."""

    body: BodyModel
    label: str = ""

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
            found = surface_jacobian(self.body, betas, pose, vertices=ids)
            parts = [found.vertices_betas[..., :count], flatten(found.vertices_pose, -2)]
            yield slice(first, first + len(ids)), found.surface.vertices, np.concatenate(parts, -1)

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
    return replace(body, posedirs=None)
