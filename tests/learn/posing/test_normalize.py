"""A registration brought to the rest pose is that registration again when posed, with its own
joints (S 4.2).
"""

import numpy as np
import pytest
from small_rigs import people, poses, small_body, small_rig

from habitus.body.skinning import SKINNING
from habitus.learn.posing.rig import RestPerson
from habitus.learn.posing.surface import pose_normalized, surface

SMALL = small_body()
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))


@skinnings
@pytest.mark.parametrize("shape_features", [0, 1])
@pytest.mark.parametrize("largest", [0.3, 1.2])
def test_posed_again_it_is_the_registration(skinning, shape_features, largest):
    rig = small_rig(SMALL, 1, skinning, shape_features=shape_features)
    rng = np.random.default_rng(0)
    general, *_ = people(SMALL, 1, 1, shape_features)
    for pose in poses(5, 1, largest):
        target = (
            surface(rig, general, pose)
            + 0.02 * rng.normal(size=SMALL.vertices.shape)
            + 0.1 * rng.normal(size=3)
        )
        found = pose_normalized(rig, SMALL.regressor, general, pose, target)
        joints = SMALL.regressor @ found
        apart = surface(rig, RestPerson(found, joints, general.descriptor), pose) - target
        assert np.abs(apart - apart.mean(0)).max() < 1e-6  # but for the place
        assert np.abs(joints[0] - general.joints[0]).max() < 1e-12


@skinnings
def test_planted_people_are_found(skinning):
    rig = small_rig(SMALL, 2, skinning)
    general, *others = people(SMALL, 4, 2, symmetric=False)
    for person, pose in zip(others, poses(3, 2), strict=True):
        found = pose_normalized(
            rig, SMALL.regressor, general, pose, surface(rig, person, pose) - 0.1
        )
        assert np.abs(found - person.template - (general.joints[0] - person.joints[0])).max() < 1e-6


@skinnings
def test_where_it_stands_does_not_matter(skinning):
    """The surface comes back at the same place however far away it was scanned."""
    rig, (general, person), (pose,) = (
        small_rig(SMALL, 3, skinning),
        people(SMALL, 2, 3),
        poses(1, 3),
    )
    target = surface(rig, person, pose)
    here, there = (
        pose_normalized(rig, SMALL.regressor, general, pose, target + shift) for shift in (0.0, 5.0)
    )
    assert np.abs(here - there).max() < 1e-5


def test_what_a_pose_squeezes_flat_is_the_general_persons():
    """Halfway between two half-turned joints a vertex of linear skinning keeps only what lies along
    the axis.
    """
    rig = small_rig(SMALL, size=None, count=2)
    rig.value[:] = 0.5
    general, person = people(SMALL, 2, 4)
    pose = np.zeros((6, 3))
    pose[:, 0] = np.pi * np.array([0, 1, 1, 1, 1, 1])
    found = pose_normalized(rig, SMALL.regressor, general, pose, surface(rig, person, pose))
    assert np.isfinite(found).all() and np.abs(found - general.template).max() < 1.0
