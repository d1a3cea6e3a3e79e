"""What a body can be told, and what it answers."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class BodyState:
    """The unknowns of a body: shape, pose, place, and (optional) soft tissue as offsets of the shape coefficients."""

    betas: Float[Tensor, "*#batch B"]
    pose: Float[Tensor, "*#batch J 3"]
    trans: Float[Tensor, "*#batch 3"]
    soft_tissue: Float[Tensor, "*#batch B"] | None = None

    def __getitem__(self, index: int | slice) -> "BodyState":
        """The states of some frames: indexes the first axis of everything that has a batch; a shared shape stays."""
        betas = self.betas if self.betas.ndim == 1 else self.betas[index]
        soft = self.soft_tissue if self.soft_tissue is None else self.soft_tissue[index]
        return BodyState(betas, self.pose[index], self.trans[index], soft)


@dataclass(frozen=True)
class BodySurface:
    """A posed body in metres: vertices (all, or the asked ones in the asked order) and joints."""

    vertices: Float[Tensor, "*batch N 3"]
    joints: Float[Tensor, "*batch J 3"]


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian over the flat pose without its root (rotation vectors, rad): mean and inverse covariance."""

    mean: Float[Tensor, " P"]
    precision: Float[Tensor, "P P"]

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "PosePrior":
        """The same prior in another dtype or on another device."""
        return PosePrior(self.mean.to(dtype=dtype, device=device), self.precision.to(dtype=dtype, device=device))
