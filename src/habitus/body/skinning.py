"""Two skinning functions with one signature: linear blend and dual quaternion blend skinning (S 3, eq. 2).

Both take rest vertices laid out (*batch, 3, N), motions (*batch, J, 3, 4) that carry rest vertices along with each
joint, and the influences of each vertex, and give posed vertices (*batch, 3, N). Coordinates come before vertices so
that every operation runs over contiguous vertices.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.rotations import dual_quaternion_from_rigid, quaternion_conjugate, quaternion_multiply

_CHUNK_FLOATS = 700_000  # blended motions held at once on a CPU: they stay in its cache and need no fresh pages


@dataclass(frozen=True)
class Influences:
    """Which joints move which vertices: the same weights dense, and as the few joints that matter."""

    dense: Float[Tensor, "J N"]
    index: Int[Tensor, "N K"]
    value: Float[Tensor, "N K"]

    def select(self, vertices: Int[Tensor, " n"]) -> "Influences":
        """The influences of some vertices only."""
        return Influences(self.dense[:, vertices].contiguous(), self.index[vertices], self.value[vertices])


def skin(
    name: str,
    rest: Float[Tensor, "*#batch 3 N"],
    motions: Float[Tensor, "*batch J 3 4"],
    trans: Float[Tensor, "*#batch 3"],
    influences: Influences,
) -> Float[Tensor, "*batch N 3"]:
    """Pose rest vertices (m) with the skinning function of that name, then move them by ``trans`` (m).

    A few of the batch are done at once, as many as a CPU's cache holds.
    """
    batch, n = motions.shape[:-3], rest.shape[-1]
    rest, motions, trans = (x.expand(*batch, *x.shape[-k:]) for x, k in ((rest, 2), (motions, 3), (trans, 1)))
    if not batch:
        return (SKINNING[name](rest, motions, influences) + trans[:, None]).mT.contiguous()
    rest, motions, trans = rest.flatten(0, -3), motions.flatten(0, -4), trans.flatten(0, -2)[..., None]
    step = max(1, _CHUNK_FLOATS // (12 * n)) if rest.device.type == "cpu" else max(1, len(motions))
    chunks = zip(rest.split(step), motions.split(step), trans.split(step), strict=True)
    return torch.cat([(SKINNING[name](few, moves, influences) + t).mT for few, moves, t in chunks]).unflatten(0, batch)


def linear_blend(
    rest: Float[Tensor, "*batch 3 N"], motions: Float[Tensor, "*batch J 3 4"], influences: Influences
) -> Float[Tensor, "*batch 3 N"]:
    """Move each vertex by the weighted mean of its joints' motions (S 3, eq. 2)."""
    blended = (motions.flatten(-2).mT @ influences.dense).unflatten(-2, (3, 4))
    moved = torch.addcmul(blended[..., 3, :], blended[..., 0, :], rest[..., None, 0, :])
    moved = torch.addcmul(moved, blended[..., 1, :], rest[..., None, 1, :])
    return torch.addcmul(moved, blended[..., 2, :], rest[..., None, 2, :])


def dual_quaternion_blend(
    rest: Float[Tensor, "*batch 3 N"], motions: Float[Tensor, "*batch J 3 4"], influences: Influences
) -> Float[Tensor, "*batch 3 N"]:
    """Move each vertex by the normalised weighted sum of its joints' dual quaternions (Kavan et al. 2008; DQBS in S 3).

    A joint's quaternion enters with the sign that makes it agree with that of the vertex' strongest joint.
    """
    blended = blended_dual_quaternions(dual_quaternion_from_rigid(motions[..., :3], motions[..., 3]), influences)
    real, dual = blended[..., :4], blended[..., 4:]
    return transform_points(real, dual, rest.mT).mT


def signed_weights(real: Float[Tensor, "*batch J 4"], influences: Influences) -> Float[Tensor, "*batch N K"]:
    """Skinning weights with the sign that turns each joint's quaternion to the side of the strongest joint's."""
    strongest = influences.index.gather(-1, influences.value.argmax(-1, keepdim=True))
    agree = real @ real.mT >= 0
    signs = agree[..., strongest, influences.index]
    return torch.where(signs, influences.value, -influences.value)


def blended_dual_quaternions(
    dual_quaternions: Float[Tensor, "*batch J 8"], influences: Influences
) -> Float[Tensor, "*batch N 8"]:
    """Each vertex' weighted sum of dual quaternions, not normalised."""
    weights = signed_weights(dual_quaternions[..., :4], influences)
    return (weights[..., None] * dual_quaternions[..., influences.index, :]).sum(-2)


def transform_points(
    real: Float[Tensor, "*batch N 4"], dual: Float[Tensor, "*batch N 4"], points: Float[Tensor, "*batch N 3"]
) -> Float[Tensor, "*batch N 3"]:
    """Apply dual quaternions to points (m), normalising them on the way."""
    conjugate = quaternion_conjugate(real)
    axis = real[..., 1:]
    points = points.expand_as(axis)
    twice = 2 * torch.linalg.cross(axis, torch.linalg.cross(axis, points) + real[..., :1] * points)
    shift = 2 * quaternion_multiply(dual, conjugate)[..., 1:]
    return points + (twice + shift) / (real * real).sum(-1, keepdim=True)


SKINNING = {"lbs": linear_blend, "dqbs": dual_quaternion_blend}
