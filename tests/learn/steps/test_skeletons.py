"""All of one subject at once: the eliminated step is the whole system's, and joints are found where
turns crawl.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_rigs import FLIP, JOINT_MIRROR, PARENTS, people, planted, poses, small_body, small_rig

from habitus.body.skinning import SKINNING
from habitus.learn.estimate import PosedTarget
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.learn.posing.rig import RestPerson
from habitus.learn.posing.surface import skeleton, surface
from habitus.learn.steps.poses import fit_pose, surface_jacobians
from habitus.learn.steps.skeletons import (
    Sample,
    SampledSubject,
    SampledTarget,
    refine,
    remove_mean_rotation,
    sample_parts,
    subset_rig,
)
from habitus.learn.steps.subjects import solve_subject
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

SMALL = small_body(pairs=4, middle=2)
WEIGHTS = EnergyWeights(symmetry=0.3, joint_symmetry=2.0, joints=0.5)
FIRST_DAMPING = 1e-4  # of the first step
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))
mirrors = pytest.mark.parametrize("mirror", [True, False])


def refined(problem, rig, sample, subject, targets, ring, steps):
    return refine(
        problem, rig, sample, subject, [SampledTarget(target) for target in targets], ring, steps
    )


def one_subject(skinning, mirror, seed=0, noise=0.01, features="rotations", shape_features=0):
    """A problem of one subject, its sample, a disturbed subject, targets, and the ring's joints."""
    options = TrainOptions(
        skinning=skinning, weights=WEIGHTS, pose_features=features, shape_features=shape_features
    )
    problem, truth = planted(options, small=SMALL, seed=seed, subjects=1, each=5, noise=noise)
    if not mirror:
        problem = replace(problem, anatomy=replace(problem.anatomy, mirror=None, joint_mirror=None))
    sample = sample_parts(problem.initial_weights, problem.anatomy.mirror)
    rng = np.random.default_rng([seed, 9])
    person = truth.person(0)
    off = RestPerson(
        person.template[sample.vertices] + 0.01 * rng.normal(size=(len(sample.vertices), 3)),
        person.joints + 0.01 * rng.normal(size=person.joints.shape),
        person.descriptor,
    )
    subject = SampledSubject(
        off, truth.pose + 0.1 * rng.normal(size=truth.pose.shape), truth.trans + 0.01
    )
    targets = problem.registrations.vertices[:, sample.vertices]
    ring = person.joints + 0.02 * rng.normal(size=person.joints.shape)
    return problem, subset_rig(truth.rig, sample.vertices), sample, subject, targets, ring


def residuals(problem, rig, sample, subject, targets, ring):
    """Everything that is squared and summed, and its derivative: rest vertices, joints, then poses
    with places.
    """
    person = subject.person
    count = len(sample.vertices)
    joints = subject.person.joints.size
    frames = len(targets)
    columns = joints + 3
    width = 3 * count + joints + frames * columns
    root = np.sqrt(np.repeat(sample.count, 3))
    rows = []
    slopes = []
    for k in range(frames):
        moved, pose_jacobian, turn, joint_jacobian = surface_jacobians(rig, person, subject.pose[k])
        slope = np.zeros((count, 3, width))
        for v in range(count):
            slope[v, :, 3 * v : 3 * v + 3] = turn[v]
        slope[:, :, 3 * count : 3 * count + joints] = joint_jacobian
        first = 3 * count + joints + k * columns
        slope[:, :, first : first + joints] = pose_jacobian
        slope[:, :, first + joints : first + columns] = np.eye(3)
        rows.append(root * (moved + subject.trans[k] - targets[k]).ravel())
        slopes.append(root[:, None] * slope.reshape(3 * count, width))
    unit = np.eye(width)
    weights = problem.options.weights
    rest = unit[: 3 * count].reshape(count, 3, width)
    bones = unit[3 * count : 3 * count + joints]
    bones = bones.reshape(-1, 3, width)
    held = [(weights.joints, person.joints - ring, bones)]
    if problem.anatomy.mirror is not None:
        each = weights.symmetry * sample.count[:, None]
        apart = person.template - person.template[sample.partner] * FLIP
        held.append((each, apart, rest - rest[sample.partner] * FLIP[:, None]))
        both = weights.symmetry * weights.joint_symmetry
        apart = person.joints - person.joints[JOINT_MIRROR] * FLIP
        held.append((both, apart, bones - bones[JOINT_MIRROR] * FLIP[:, None]))
    for weight, value, slope in held:
        scale = np.sqrt(np.broadcast_to(weight, value.shape))
        rows.append((scale * value).ravel())
        slopes.append((scale[..., None] * slope).reshape(value.size, width))
    return np.concatenate(rows), np.concatenate(slopes)


def energy(problem, rig, sample, subject, targets, ring):
    """The same, without derivatives."""
    person = subject.person
    weights = problem.options.weights
    total = weights.joints * ((person.joints - ring) ** 2).sum()
    for pose, trans, target in zip(subject.pose, subject.trans, targets, strict=True):
        total += sample.count @ ((surface(rig, person, pose) + trans - target) ** 2).sum(1)
    if problem.anatomy.mirror is not None:
        total += weights.symmetry * (
            sample.count @ ((person.template - person.template[sample.partner] * FLIP) ** 2).sum(1)
            + weights.joint_symmetry
            * ((person.joints - person.joints[JOINT_MIRROR] * FLIP) ** 2).sum()
        )
    return total


def whole_step(damping, *parts):
    """The step of the dense system, damped as said: poses first, then what is left once they are
    eliminated.
    """
    row, slope = residuals(*parts)
    matrix = slope.T @ slope
    pull = -slope.T @ row
    sample = parts[2]
    subject = parts[3]
    shared = 3 * len(sample.vertices) + subject.person.joints.size
    own = slice(shared, None)
    matrix[own, own] += np.diag(damping * matrix[own, own].diagonal() + 1e-12)
    left = matrix[:shared, :shared] - matrix[:shared, own] @ np.linalg.solve(
        matrix[own, own], matrix[own, :shared]
    )
    matrix[:shared, :shared] += np.diag(damping * np.abs(left.diagonal()) + 1e-9)
    return np.linalg.solve(matrix, pull)


@skinnings
@mirrors
@pytest.mark.parametrize("shape_features", [0, 1])
def test_a_step_is_that_of_the_whole_system(skinning, mirror, shape_features):
    parts = one_subject(skinning, mirror, shape_features=shape_features)
    subject = parts[3]
    step = whole_step(FIRST_DAMPING, *parts)
    moved = refined(*parts, 1)
    assert energy(*parts) == pytest.approx((residuals(*parts)[0] ** 2).sum(), rel=1e-12)
    assert energy(*parts[:3], moved, *parts[4:]) < energy(*parts)
    rest = subject.person.template.size
    joints = subject.person.joints.size
    found = np.concatenate(
        [
            (moved.person.template - subject.person.template).ravel(),
            (moved.person.joints - subject.person.joints).ravel(),
            np.concatenate(
                [
                    (moved.pose - subject.pose).reshape(len(subject.pose), -1),
                    moved.trans - subject.trans,
                ],
                1,
            ).ravel(),
        ]
    )
    assert np.abs(found - step).max() < 1e-6 * np.abs(step).max()
    assert np.abs(step[: rest + joints]).max() > 1e-3


@skinnings
@pytest.mark.parametrize("features", ["rotations", "angles"])
def test_the_energy_never_rises(skinning, features):
    for seed in range(2):
        parts = one_subject(skinning, seed > 0, seed, noise=0.05, features=features)
        before = energy(*parts)
        for _ in range(4):
            parts = (*parts[:3], refined(*parts, 1), *parts[4:])
            after = energy(*parts)
            assert after <= before * (1 + 1e-12)
            before = after


@skinnings
def test_steps_lead_to_where_nothing_pulls(skinning):
    parts = one_subject(skinning, True)
    row, slope = residuals(*parts)
    start = np.abs(slope.T @ row).max()
    parts = (*parts[:3], refined(*parts, 8), *parts[4:])
    row, slope = residuals(*parts)
    assert np.abs(slope.T @ row).max() < 1e-5 * start


@skinnings
def test_joints_are_found_where_taking_turns_crawls(skinning):
    """No pose blend shapes, and hardly a hold on the joints: the motion alone tells them."""
    weights = EnergyWeights(symmetry=1.0, joint_symmetry=1.0, joints=1e-6)
    options = TrainOptions(skinning=skinning, pose_shapes="none", weights=weights)
    problem, truth = planted(options, small=SMALL, subjects=1, each=7)
    person = truth.person(0)
    off = 0.03 * np.random.default_rng(3).normal(size=(len(PARENTS), 3))
    off = (off + off[JOINT_MIRROR] * FLIP) / 2
    ring = person.joints + off
    targets = problem.registrations.vertices
    everything = Sample(
        np.arange(len(SMALL.vertices)), np.ones(len(SMALL.vertices)), problem.anatomy.mirror
    )
    rig = truth.rig
    start = RestPerson(person.template, ring, person.descriptor)
    fits = [
        fit_pose(rig, start, t, p, max_iterations=8)
        for t, p in zip(targets, truth.pose, strict=True)
    ]

    def missed(joints, turns, places):
        """How far the posed joints are off (m), but for the root's, which the place makes up
        for.
        """
        apart = [
            skeleton(PARENTS, mine).positions(joints)
            + place
            - skeleton(PARENTS, theirs).positions(person.joints)
            - other
            for mine, place, theirs, other in zip(
                turns, places, truth.pose, truth.trans, strict=True
            )
        ]
        return np.linalg.norm(np.array(apart)[:, 1:], axis=-1).mean()

    subject = SampledSubject(
        start, np.stack([fit.pose for fit in fits]), np.stack([fit.trans for fit in fits])
    )
    begun = missed(ring, subject.pose, subject.trans)
    together = refined(problem, rig, everything, subject, targets, ring, 7)
    in_turns = start
    turns = fits
    for _ in range(5):
        posed = [PosedTarget(t, fit.pose, fit.trans) for t, fit in zip(targets, turns, strict=True)]
        found = solve_subject(rig, person.descriptor, posed, problem.anatomy, weights)
        in_turns = RestPerson(*found, person.descriptor)
        turns = [
            fit_pose(rig, in_turns, t, fit.pose) for t, fit in zip(targets, turns, strict=True)
        ]
    crawled = missed(in_turns.joints, [fit.pose for fit in turns], [fit.trans for fit in turns])
    assert missed(together.person.joints, together.pose, together.trans) < 1e-6
    assert begun > 0.03 and crawled > 0.01


# samples


@mirrors
def test_samples_hold_every_part_and_count_every_vertex(mirror):
    small = small_body(pairs=40, middle=5)
    part = small.weights.argmax(1)
    sample = sample_parts(small.weights, small.mirror if mirror else None)
    assert set(part[sample.vertices]) == set(part) and len(sample.vertices) < len(part) / 2
    assert sample.count.sum() == pytest.approx(len(part), rel=1e-12)
    for joint in set(part):
        own = part[sample.vertices] == joint
        assert 5 <= own.sum() <= 26
        assert sample.count[own].sum() == pytest.approx((part == joint).sum(), rel=0.05)
    wanted = small.mirror[sample.vertices] if mirror else sample.vertices
    assert np.array_equal(sample.vertices[sample.partner], wanted)
    assert np.array_equal(sample.count[sample.partner], sample.count)


def test_small_parts_are_taken_whole():
    part = np.repeat(np.arange(3), (7, 8, 50))
    sample = sample_parts(np.eye(3)[part], None)
    taken = np.isin(np.arange(len(part)), sample.vertices)
    assert taken[part < 2].all() and 4 <= taken[part == 2].sum() < 20
    assert np.allclose(sample.count[part[sample.vertices] < 2], 1.0)
    assert np.array_equal(sample.partner, np.arange(len(sample.vertices)))


@skinnings
def test_some_rows_of_a_rig_pose_as_all_of_them(skinning):
    rig = small_rig(SMALL, 1, skinning, shape_features=1)
    rows = np.array([5, 2, 30])
    (person,), (pose,) = people(SMALL, 1, shape_features=1), poses(1)
    few = RestPerson(person.template[rows], person.joints, person.descriptor)
    assert (
        np.abs(surface(subset_rig(rig, rows), few, pose) - surface(rig, person, pose)[rows]).max()
        < 1e-14
    )


def test_what_all_poses_turn_alike_is_turned_back():
    rng = np.random.default_rng(3)
    before = 0.8 * rng.normal(size=(7, len(PARENTS), 3))
    turns = matrix_from_rotvec(torch.from_numpy(0.5 * rng.normal(size=(len(PARENTS), 3)))).numpy()
    world = np.stack([skeleton(PARENTS, pose).world for pose in before]) @ turns
    above = np.stack(
        [np.eye(3)[None].repeat(7, 0), *(world[:, parent] for parent in PARENTS[1:])], 1
    )
    after = rotvec_from_matrix(torch.from_numpy(above.transpose(0, 1, 3, 2) @ world)).numpy()
    back = remove_mean_rotation(PARENTS, before, after)
    same = [
        np.abs(skeleton(PARENTS, a).world - skeleton(PARENTS, b).world).max()
        for a, b in zip(before, back, strict=True)
    ]
    assert np.abs(after - before).max() > 0.3 and max(same) < 1e-9
