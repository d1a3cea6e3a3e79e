"""Models that can be posed and fitted to registrations, to be compared with each other (S 5.1)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float

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
        """The least squares of vertex distance (m) over pose, trans and shape, or with the shape ``betas`` fixed."""
        ...

    def forward(self, num_betas: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The function (betas, pose) -> vertices with that many coefficients; with 0 the mean shape is made once."""
        ...


@dataclass(frozen=True, eq=False)
class PosableBody(FittedToSurfaces):
    """A BodyModel as something to be fitted; numbers are float64 whatever the body's are."""

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
        return self._exact.skinning_weights.numpy()

    @cached_property
    def _exact(self) -> BodyModel:
        return self.body.to(dtype=torch.float64)

    def surface(self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "V 3"]:
        """Vertices (m) of the first so many shape coefficients and of a pose (rotation vectors, rad)."""
        return self._exact(self._all(betas), torch.from_numpy(pose)).vertices.numpy()

    def columns(
        self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"], by_betas: bool
    ) -> Iterator[Columns]:
        """Vertices and their exact derivatives, ``BLOCK`` vertices at a time."""
        shape, turns, count = self._all(betas), torch.from_numpy(pose), len(betas) if by_betas else 0
        for first in range(0, self.body.num_vertices, BLOCK):
            ids = torch.arange(first, min(first + BLOCK, self.body.num_vertices))
            found = surface_jacobian(self._exact, shape, turns, vertices=ids)
            parts = [found.vertices_betas[..., :count], found.vertices_pose.flatten(-2)]
            yield slice(first, first + len(ids)), found.surface.vertices.numpy(), torch.cat(parts, -1).numpy()

    def forward(self, num_betas: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The function (betas, pose) -> vertices with that many coefficients; with 0 the mean shape is made once."""
        if num_betas == 0:
            prepared = self._exact.prepare(self._all(np.zeros(0)))
            return lambda _, pose: prepared(torch.from_numpy(pose)).vertices.numpy()
        body = self._exact.with_betas(max(num_betas, self.body.shape_features))
        fill = (0, body.num_betas - num_betas)
        return lambda betas, pose: body(
            torch.nn.functional.pad(torch.from_numpy(betas), fill), torch.from_numpy(pose)
        ).vertices.numpy()

    def _all(self, betas: np.ndarray) -> torch.Tensor:
        return torch.nn.functional.pad(torch.from_numpy(betas), (0, self.num_betas - len(betas)))


def without_pose_shapes(body: BodyModel) -> BodyModel:
    """The same body as plain blend skinning: what S 5.1 calls LBS, "the SMPL-LBS model with no pose blend shapes"."""
    return replace(body, posedirs=None)
