"""The poses of simulated flesh: every round gives each person sessions that can be walked."""

import numpy as np
import pytest

from habitus.body.joint_layouts import LAYOUTS
from habitus_lab.default_body.flesh.poses import (
    SHRUGS,
    further_sessions,
    rounds_of_sessions,
    shrug_sessions,
)

JOINTS = LAYOUTS["smplx"].joint_names
ROUNDS = {
    "units": lambda *person: [s for turn in rounds_of_sessions(*person) for s in turn],
    "further": further_sessions,
    "shrugs": shrug_sessions,
}


@pytest.mark.parametrize("name", ROUNDS)
def test_a_round_is_the_same_each_time_and_moves_joints(name):
    first, again = (ROUNDS[name](0, 3, "female", JOINTS) for _ in range(2))
    assert len({session.name for session in first}) == len(first) > 0
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.poses, other.poses) and one.names == other.names
        assert one.poses.shape[1:] == (len(JOINTS), 3) and len(one.names) == len(one.poses)
        assert np.abs(one.poses).max(axis=(1, 2)).min() > 0.02


def test_shrugs_move_arms_alone_and_every_unit_once():
    found = shrug_sessions(0, 3, "female", JOINTS)
    moved = {JOINTS[j] for session in found for j in np.flatnonzero(session.poses.any((0, 2)))}
    assert moved <= {
        f"{side}_{joint}" for side in ("left", "right") for joint in ("collar", "shoulder")
    }
    assert sum(any(unit in name for s in found for name in s.names) for unit in SHRUGS) == len(
        SHRUGS
    )
