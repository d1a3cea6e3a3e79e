from itertools import pairwise

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.body.skinning import ancestors, descends, skinning_motions, world_motions
from habitus.rotations import matrix_from_rotvec

trees = st.lists(st.floats(0, 0.999), min_size=0, max_size=12).map(
    lambda draws: (-1, *(int(draw * joint) for joint, draw in enumerate(draws, 1)))
)


@settings(max_examples=60, deadline=None)
@given(trees, st.integers(0, 1000))
def test_levels_walk_any_tree_as_a_loop_would(parents, seed):
    generator = torch.Generator().manual_seed(seed)
    rotations = matrix_from_rotvec(
        torch.randn(2, len(parents), 3, generator=generator, dtype=torch.float64)
    )
    rest = torch.randn(2, len(parents), 3, generator=generator, dtype=torch.float64)
    found = world_motions(rotations, rest, parents)
    world = [rotations[:, 0]]
    place = [rest[:, 0]]
    for joint, parent in enumerate(parents[1:], 1):
        world.append(world[parent] @ rotations[:, joint])
        bone = (rest[:, joint] - rest[:, parent])[..., None]
        place.append(place[parent] + (world[parent] @ bone)[..., 0])
    assert torch.allclose(found[..., :3], torch.stack(world, 1), atol=1e-13)
    assert torch.allclose(found[..., 3], torch.stack(place, 1), atol=1e-12)
    carried = skinning_motions(found, rest)
    assert torch.allclose(
        (carried[..., :3] @ rest[..., None])[..., 0] + carried[..., 3], found[..., 3], atol=1e-12
    )


@settings(max_examples=60, deadline=None)
@given(trees)
def test_ancestors_and_descendants_are_two_sides_of_one_table(parents):
    table = descends(parents)
    for joint, chain in enumerate(ancestors(parents)):
        assert chain[0] == 0 and chain[-1] == joint
        assert all(parents[child] == parent for parent, child in pairwise(chain))
        assert table[:, joint].nonzero()[0].tolist() == sorted(chain)
