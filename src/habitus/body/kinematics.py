"""The skeleton: from rotations relative to the parent to rigid motions in the world (S 3, eqs. 3 and 4)."""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor


@lru_cache(maxsize=64)
def ancestors(parents: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """For each joint the joints that move it, from the root to itself: A(k) of eq. 4."""
    chains: list[tuple[int, ...]] = []
    for joint, parent in enumerate(parents):
        chains.append((*chains[parent], joint) if parent >= 0 else (joint,))
    return tuple(chains)


@lru_cache(maxsize=64)
def descends(parents: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Float[Tensor, "J J"]:
    """1 at [j, k] where joint k is j or hangs below it, 0 elsewhere. Not to be written to."""
    table = torch.zeros(len(parents), len(parents), dtype=dtype)
    for joint, chain in enumerate(ancestors(parents)):
        table[list(chain), joint] = 1
    return table.to(device)


@lru_cache(maxsize=64)
def _levels(parents: tuple[int, ...], device: torch.device) -> tuple[tuple[tuple[Tensor, Tensor], ...], Tensor]:
    """Per level of the tree below the root (its joints, places of its parents one level up), and each joint's row."""
    depth = [len(chain) - 1 for chain in ancestors(parents)]
    rows = [[j for j, d in enumerate(depth) if d == level] for level in range(max(depth) + 1)]
    place = {joint: row.index(joint) for row in rows for joint in row}
    steps = tuple(
        (torch.tensor(row).to(device), torch.tensor([place[parents[j]] for j in row]).to(device)) for row in rows[1:]
    )
    order = [joint for row in rows for joint in row]
    return steps, torch.tensor([order.index(j) for j in range(len(parents))]).to(device)


@lru_cache(maxsize=64)
def _parent_rows(parents: tuple[int, ...], device: torch.device) -> Tensor:
    return torch.tensor(parents[1:], dtype=torch.int64).to(device)


def world_motions(
    rotations: Float[Tensor, "*batch J 3 3"], rest_joints: Float[Tensor, "*batch J 3"], parents: tuple[int, ...]
) -> Float[Tensor, "*batch J 3 4"]:
    """[R_k | p_k] of each joint: its rotation in the world and where it stands (m), in the body's space.

    ``rotations`` are relative to the parent; ``rest_joints`` (m) are those of the shaped rest surface. The chain is
    walked level by level of the tree, all joints of a level at once.
    """
    above = torch.index_select(rest_joints, -2, _parent_rows(parents, rest_joints.device))
    offsets = torch.cat([rest_joints[..., :1, :], rest_joints[..., 1:, :] - above], -2)
    local = torch.cat([rotations, offsets[..., None]], -1)
    steps, rows = _levels(parents, rotations.device)
    level = local[..., :1, :, :]
    levels = [level]
    for joints, places in steps:
        parent = level.index_select(-3, places)
        moved = parent[..., :3] @ local.index_select(-3, joints)
        level = torch.cat([moved[..., :3], moved[..., 3:] + parent[..., 3:]], -1)
        levels.append(level)
    return torch.cat(levels, -3).index_select(-3, rows)


def skinning_motions(
    world: Float[Tensor, "*batch J 3 4"], rest_joints: Float[Tensor, "*batch J 3"]
) -> Float[Tensor, "*batch J 3 4"]:
    """[R_k | p_k - R_k J_k]: the motions that take rest vertices along with joint k (G' of eq. 3)."""
    shift = world[..., :3] @ rest_joints[..., None]
    return torch.cat([world[..., :3], world[..., 3:] - shift], -1)
