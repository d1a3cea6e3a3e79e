"""Two skinning functions with one signature: linear blend and dual quaternion blend skinning (S 3,
eq. 2).

Both take rest vertices laid out (*batch, 3, N), motions (*batch, J, 3, 4) that carry rest vertices
along with each joint, and the influences of each vertex, and give posed vertices (*batch, 3, N).
Coordinates come before vertices so that every operation runs over contiguous vertices.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import (
    cast,
    cross,
    flatten,
    multiply_add,
    namespace,
    take,
    take_along,
    unflatten,
)
from habitus.rotations import dual_quaternion_from_rigid
from habitus.types import Array

_CHUNK_FLOATS = (
    700_000  # blended motions held at once on a CPU: they stay in its cache and need no fresh pages
)


@dataclass(frozen=True)
class Influences:
    """Which joints move which vertices: the same weights dense, and as the few joints that
    matter.
    """

    dense: Float[Array, "J N"]
    index: Int[Array, "N K"]
    value: Float[Array, "N K"]


def skin(
    name: str,
    rest: Float[Array, "*#batch 3 N"],
    motions: Float[Array, "*batch J 3 4"],
    trans: Float[Array, "*#batch 3"],
    influences: Influences,
) -> Float[Array, "*batch N 3"]:
    """Pose rest vertices (m) with the skinning function of that name, then move them by ``trans``
    (m).

    A few of the batch are done at once, as many as a CPU's cache holds.
    """
    xp = namespace(motions)
    blend = SKINNING[name]
    batch = motions.shape[:-3]
    n = rest.shape[-1]
    rest = xp.broadcast_to(rest, (*batch, 3, n))
    trans = xp.broadcast_to(trans, (*batch, 3))[..., None]
    if not batch:
        moved = (blend(rest, motions, influences) + trans).mT
        return np.ascontiguousarray(moved) if xp is np else moved.contiguous()
    rest = flatten(rest, 0, -3)
    motions = flatten(motions, 0, -4)
    trans = flatten(trans, 0, -3)
    step = (
        max(1, _CHUNK_FLOATS // (12 * n)) if str(motions.device) == "cpu" else max(1, len(motions))
    )
    chunks = [slice(k, k + step) for k in range(0, max(1, len(motions)), step)]
    few = [(blend(rest[some], motions[some], influences) + trans[some]).mT for some in chunks]
    return unflatten(xp.concatenate(few), 0, batch)


def linear_blend(
    rest: Float[Array, "*batch 3 N"], motions: Float[Array, "*batch J 3 4"], influences: Influences
) -> Float[Array, "*batch 3 N"]:
    """Move each vertex by the weighted mean of its joints' motions (S 3, eq. 2)."""
    blended = unflatten(flatten(motions, -2).mT @ influences.dense, -2, (3, 4))
    moved = multiply_add(blended[..., 3, :], blended[..., 0, :], rest[..., None, 0, :])
    moved = multiply_add(moved, blended[..., 1, :], rest[..., None, 1, :])
    return multiply_add(moved, blended[..., 2, :], rest[..., None, 2, :])


def dual_quaternion_blend(
    rest: Float[Array, "*batch 3 N"], motions: Float[Array, "*batch J 3 4"], influences: Influences
) -> Float[Array, "*batch 3 N"]:
    """Move each vertex by the normalised weighted sum of its joints' dual quaternions (Kavan et al.
    2008; DQBS in S 3).

    A joint's quaternion enters with the sign that makes it agree with that of the vertex' strongest
    joint; where the two are half a turn apart, the result jumps.
    """
    single = dual_quaternion_from_rigid(motions[..., :3], motions[..., 3])
    return move_points(single.mT @ signed_weights(single[..., :4], influences).mT, rest)


def signed_weights(
    real: Float[Array, "*batch J 4"], influences: Influences
) -> Float[Array, "*batch N J"]:
    """Skinning weights with the sign that turns each joint's quaternion to the side of the
    strongest joint's.
    """
    strongest = take_along(influences.index, influences.value.argmax(-1)[:, None], -1)[:, 0]
    sides = 1 - 2 * cast(real @ real.mT < 0, real)
    return take(sides, strongest, -2) * influences.dense.T


def move_points(
    dual_quaternions: Float[Array, "*batch 8 N"], points: Float[Array, "*batch 3 N"]
) -> Float[Array, "*batch 3 N"]:
    """Apply dual quaternions to points (m), normalising them on the way."""
    w = dual_quaternions[..., :1, :]
    axis = dual_quaternions[..., 1:4, :]
    dual_w = dual_quaternions[..., 4:5, :]
    dual = dual_quaternions[..., 5:, :]
    turned = cross(axis, points, -2) + w * points
    moved = cross(axis, turned + dual, -2) + w * dual - dual_w * axis
    return points + 2 * moved / (w * w + (axis * axis).sum(-2)[..., None, :])


SKINNING = {"lbs": linear_blend, "dqbs": dual_quaternion_blend}
