"""The skeleton: from rotations relative to the parent to rigid motions in the world (S 3, eqs. 3
and 4).
"""

from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.arrays import namespace, take
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
