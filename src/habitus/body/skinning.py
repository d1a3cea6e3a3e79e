"""The skeleton, from rotations relative to the parent to rigid motions in the world (S 3, eqs. 3
and 4), and two skinning functions with one signature: linear blend and dual quaternion blend
skinning (S 3, eq. 2).

Both skinning functions take rest vertices laid out (*batch, 3, N), motions (*batch, J, 3, 4) that
carry rest vertices along with each joint, and the influences of each vertex, and give posed
vertices (*batch, 3, N). Coordinates come before vertices so that every operation runs over
contiguous vertices.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

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


@lru_cache(maxsize=64)
def ancestors(parents: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """For each joint the joints that move it, from the root to itself: A(k) of eq. 4."""
    chains: list[tuple[int, ...]] = []
    for joint, parent in enumerate(parents):
        chains.append((*chains[parent], joint) if parent >= 0 else (joint,))
    return tuple(chains)


@lru_cache(maxsize=64)
def descends(parents: tuple[int, ...]) -> Float[np.ndarray, "J J"]:
    """1 at [j, k] where joint k is j or hangs below it, 0 elsewhere. Not to be written to."""
    table = np.zeros((len(parents), len(parents)))
    for joint, chain in enumerate(ancestors(parents)):
        table[list(chain), joint] = 1
    return table


@lru_cache(maxsize=64)
def _levels(
    parents: tuple[int, ...], xp: Any, device: Any
) -> tuple[Array, tuple[tuple[Array, Array], ...], Array]:
    """The joints' parents (root left out), and the tree level by level.

    Per level below the root: its joints, and the places of their parents one level up; at last each
    joint's row.
    """
    depth = [len(chain) - 1 for chain in ancestors(parents)]
    rows = [[j for j, d in enumerate(depth) if d == level] for level in range(max(depth) + 1)]
    place = {joint: row.index(joint) for row in rows for joint in row}
    index = lambda numbers: xp.asarray(np.array(numbers, dtype=np.int64), device=device)  # noqa: E731
    steps = tuple((index(row), index([place[parents[j]] for j in row])) for row in rows[1:])
    order = [joint for row in rows for joint in row]
    return index(parents[1:]), steps, index([order.index(j) for j in range(len(parents))])


def world_motions(
    rotations: Float[Array, "*batch J 3 3"],
    rest_joints: Float[Array, "*batch J 3"],
    parents: tuple[int, ...],
) -> Float[Array, "*batch J 3 4"]:
    """[R_k | p_k] of each joint: its rotation in the world and where it stands (m), in the body's
    space.

    ``rotations`` are relative to the parent; ``rest_joints`` (m) are those of the shaped rest
    surface. The chain is walked level by level of the tree, all joints of a level at once.
    """
    xp = namespace(rotations)
    above, steps, rows = _levels(parents, xp, rotations.device)
    offsets = rest_joints[..., 1:, :] - take(rest_joints, above, -2)
    offsets = xp.concatenate([rest_joints[..., :1, :], offsets], -2)
    local = xp.concatenate([rotations, offsets[..., None]], -1)
    level = local[..., :1, :, :]
    levels = [level]
    for joints, places in steps:
        parent = take(level, places, -3)
        moved = parent[..., :3] @ take(local, joints, -3)
        level = xp.concatenate([moved[..., :3], moved[..., 3:] + parent[..., 3:]], -1)
        levels.append(level)
    return take(xp.concatenate(levels, -3), rows, -3)


def skinning_motions(
    world: Float[Array, "*batch J 3 4"], rest_joints: Float[Array, "*batch J 3"]
) -> Float[Array, "*batch J 3 4"]:
    """[R_k | p_k - R_k J_k]: the motions that take rest vertices along with joint k (G' of eq.
    3).
    """
    shift = world[..., :3] @ rest_joints[..., None]
    return namespace(world).concatenate([world[..., :3], world[..., 3:] - shift], -1)


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
