"""Two skinning functions with one signature: linear blend and dual quaternion blend skinning (S 3, eq. 2).

Both take rest vertices laid out (*batch, 3, N), motions (*batch, J, 3, 4) that carry rest vertices along with each
joint, and the influences of each vertex, and give posed vertices (*batch, 3, N). Coordinates come before vertices so
that every operation runs over contiguous vertices.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.rotations import dual_quaternion_from_rigid

_CHUNK_FLOATS = 700_000  # blended motions held at once on a CPU: they stay in its cache and need no fresh pages


@dataclass(frozen=True)
class Influences:
    """Which joints move which vertices: the same weights dense, and as the few joints that matter."""

    dense: Float[Tensor, "J N"]
    index: Int[Tensor, "N K"]
    value: Float[Tensor, "N K"]


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

    A joint's quaternion enters with the sign that makes it agree with that of the vertex' strongest joint; where the
    two are half a turn apart, the result jumps.
    """
    single = dual_quaternion_from_rigid(motions[..., :3], motions[..., 3])
    return move_points(single.mT @ signed_weights(single[..., :4], influences).mT, rest)


def signed_weights(real: Float[Tensor, "*batch J 4"], influences: Influences) -> Float[Tensor, "*batch N J"]:
    """Skinning weights with the sign that turns each joint's quaternion to the side of the strongest joint's."""
    strongest = influences.index.gather(-1, influences.value.argmax(-1, keepdim=True))[:, 0]
    sides = torch.where(real @ real.mT < 0, -1.0, 1.0).to(real.dtype)
    return sides.index_select(-2, strongest) * influences.dense.T


def move_points(
    dual_quaternions: Float[Tensor, "*batch 8 N"], points: Float[Tensor, "*batch 3 N"]
) -> Float[Tensor, "*batch 3 N"]:
    """Apply dual quaternions to points (m), normalising them on the way."""
    w, axis, dual_w, dual = dual_quaternions.split([1, 3, 1, 3], -2)
    turned = torch.linalg.cross(axis, points.expand_as(axis), dim=-2) + w * points
    moved = torch.linalg.cross(axis, turned + dual, dim=-2) + w * dual - dual_w * axis
    return points + 2 * moved / (w * w + (axis * axis).sum(-2, keepdim=True))


SKINNING = {"lbs": linear_blend, "dqbs": dual_quaternion_blend}
