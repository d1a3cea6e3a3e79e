"""A subject's rest surface and joints are the minimum of E_D + E_Y + E_J (S 4.1, eq. 14)."""

import numpy as np
import pytest
import torch
from small_rigs import (
    FLIP,
    JOINT_MIRROR,
    PARENTS,
    people,
    poses,
    small_body,
    small_rig,
    torch_surface,
)

from habitus.body.skinning import SKINNING
from habitus.learn.energy import costs, subject_terms
from habitus.learn.options import EnergyWeights
from habitus.learn.posing.rig import RestPerson
from habitus.learn.posing.surface import surface
from habitus.learn.steps.subjects import (
    Anatomy,
    PosedTarget,
    joint_asymmetry,
    solve_subject,
    subject_energy,
)

SMALL = small_body()
ANATOMIES = {
    "no mirror": Anatomy(None, None, SMALL.regressor),
    "mirror": Anatomy(SMALL.mirror, JOINT_MIRROR, SMALL.regressor),
    "mirrored surface": Anatomy(SMALL.mirror, None, SMALL.regressor),
    "mirrored joints": Anatomy(None, JOINT_MIRROR, SMALL.regressor),
}
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))
anatomies = pytest.mark.parametrize("anatomy", list(ANATOMIES.values()), ids=list(ANATOMIES))


def registered(rig, person, count=6, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    return [
        PosedTarget(
            surface(rig, person, pose) + place + noise * rng.normal(size=person.template.shape),
            pose,
            place,
        )
        for pose, place in zip(poses(count, seed), rng.normal(size=(count, 3)), strict=True)
    ]


def energy(rig, template, joints, descriptor, targets, anatomy, weights):
    """E_D + lambda_Y E_Y + lambda_J E_J as the paper writes them, in torch."""
    total = weights.joints * ((torch.tensor(anatomy.regressor) @ template - joints) ** 2).sum()
    flip = torch.tensor(FLIP)
    if anatomy.mirror is not None:
        total = (
            total + weights.symmetry * ((template - (template * flip)[anatomy.mirror]) ** 2).sum()
        )
    if anatomy.joint_mirror is not None:
        apart = joints - (joints * flip)[anatomy.joint_mirror]
        total = total + weights.symmetry * weights.joint_symmetry * (apart**2).sum()
    for target in targets:
        posed = torch_surface(rig, template, joints, descriptor, target.pose)
        total = (
            total
            + ((posed + torch.tensor(target.trans) - torch.tensor(target.vertices)) ** 2).sum()
        )
    return total


@skinnings
@anatomies
@pytest.mark.parametrize("shape_features", [0, 2])
def test_the_solution_has_no_slope(skinning, anatomy, shape_features):
    rig = small_rig(SMALL, 1, skinning, shape_features=shape_features)
    (person,) = people(SMALL, 1, 1, shape_features, symmetric=False)
    targets = registered(rig, person, noise=0.01)
    weights = EnergyWeights(symmetry=3.0, joint_symmetry=5.0, joints=7.0)
    found = solve_subject(rig, person.descriptor, iter(targets), anatomy, weights)
    here = [torch.tensor(x, requires_grad=True) for x in found]
    total = energy(rig, *here, person.descriptor, targets, anatomy, weights)
    total.backward()
    start = [torch.tensor(x, requires_grad=True) for x in (person.template, person.joints)]
    energy(rig, *start, person.descriptor, targets, anatomy, weights).backward()
    for x, y in zip(here, start, strict=True):
        assert x.grad.abs().max() < 1e-9 * max(1.0, y.grad.abs().max())
    told = subject_energy(rig, RestPerson(*found, person.descriptor), targets, anatomy, weights)
    assert told == pytest.approx(total.item(), rel=1e-11)
    assert told < subject_energy(rig, person, targets, anatomy, weights)


@skinnings
@anatomies
@pytest.mark.parametrize("strength", [1e-3, 100.0])
def test_planted_people_are_found_where_what_is_held_agrees(skinning, anatomy, strength):
    rig, (person,) = small_rig(SMALL, 2, skinning), people(SMALL, 1, 2)
    targets = registered(rig, person)
    template, joints = solve_subject(
        rig, person.descriptor, targets, anatomy, EnergyWeights(symmetry=strength, joints=strength)
    )
    assert np.abs(template - person.template).max() < 1e-9
    assert np.abs(joints - person.joints).max() < 1e-9


def test_one_registration_near_rest_is_enough_with_the_papers_weights():
    rig, (person,) = small_rig(SMALL, 2), people(SMALL, 1, 2)
    targets = registered(rig, person, count=1)
    template, joints = solve_subject(
        rig, person.descriptor, targets, ANATOMIES["mirror"], EnergyWeights()
    )
    assert np.abs(template - person.template).max() < 1e-8
    assert np.abs(joints - person.joints).max() < 1e-8


def test_strong_symmetry_makes_the_lopsided_symmetric():
    rig = small_rig(SMALL, 2)
    (person,) = people(SMALL, 1, 2, symmetric=False)
    anatomy = ANATOMIES["mirror"]
    targets = registered(rig, person)
    apart = []
    for symmetry in (0.0, 1.0, 1e6):
        template, joints = solve_subject(
            rig, person.descriptor, targets, anatomy, EnergyWeights(symmetry=symmetry)
        )
        apart.append(np.abs(template - template[SMALL.mirror] * FLIP).max())
    assert apart[0] > 0.01 and apart[1] < apart[0] and apart[2] < 1e-6
    assert np.abs(joints - joints[JOINT_MIRROR] * FLIP).max() < 1e-6


def test_a_mirrored_subject_has_the_mirrored_rest_surface():
    """Everything mirrored, left and right swapped, but not the noise: a law about all terms at
    once.
    """
    rig, (person,) = small_rig(SMALL, size=None), people(SMALL, 1, 3, symmetric=False)
    targets = registered(rig, person, noise=0.01)
    turn = np.array([1.0, -1.0, -1.0])
    other = [
        PosedTarget(t.vertices[SMALL.mirror] * FLIP, t.pose[JOINT_MIRROR] * turn, t.trans * FLIP)
        for t in targets
    ]
    template, joints = solve_subject(
        rig, person.descriptor, targets, ANATOMIES["mirror"], EnergyWeights()
    )
    mirrored = solve_subject(rig, person.descriptor, other, ANATOMIES["mirror"], EnergyWeights())
    assert np.abs(mirrored[0] - template[SMALL.mirror] * FLIP).max() < 1e-10
    assert np.abs(mirrored[1] - joints[JOINT_MIRROR] * FLIP).max() < 1e-10


def test_symmetry_and_joint_terms():
    rng = np.random.default_rng(0)
    weights = EnergyWeights(symmetry=2.0, joint_symmetry=3.0, joints=5.0)
    template = rng.normal(size=SMALL.vertices.shape)
    joints = rng.normal(size=(len(PARENTS), 3))
    surfaces = ((template - template[SMALL.mirror] * FLIP) ** 2).sum()
    skeletons = ((joints - joints[JOINT_MIRROR] * FLIP) ** 2).sum()
    away = ((SMALL.regressor @ template - joints) ** 2).sum()
    expected = {
        "no mirror": (0.0, 5 * away),
        "mirror": (2 * surfaces + 6 * skeletons, 5 * away),
        "mirrored surface": (2 * surfaces, 5 * away),
        "mirrored joints": (6 * skeletons, 5 * away),
    }
    for name, anatomy in ANATOMIES.items():
        found = costs(subject_terms(anatomy, weights), {"templates": template, "joints": joints})
        assert (found["symmetry"], found["joints"]) == pytest.approx(expected[name], rel=1e-12)
    assert joints.ravel() @ joint_asymmetry(JOINT_MIRROR) @ joints.ravel() == pytest.approx(
        skeletons, rel=1e-12
    )
