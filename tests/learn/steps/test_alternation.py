"""No step of the alternation raises the energy, whatever is trained; and each does its own part
only (S 4.3).
"""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import disturbed, planted, small_body

from habitus.body.pose_features import POSE_FEATURES
from habitus.body.skinning import SKINNING
from habitus.learn.energy import costs, energy_terms, measure_energy, unknowns
from habitus.learn.options import POSE_SHAPES, EnergyWeights, TrainSettings
from habitus.learn.steps.alternation import (
    STEPS,
    over_relax,
    pose_shape_step,
    pose_step,
    subject_step,
    weight_step,
)
from habitus.learn.steps.skeletons import remove_mean_rotation
from habitus.parallel.workers import Threads

SMALL = small_body(pairs=3, middle=1)
ALONE = Threads(1)
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))
VARIANTS = [
    *({"pose_shapes": kind} for kind in POSE_SHAPES),
    *({"pose_features": name} for name in POSE_FEATURES if name != "rotations"),
    {"shape_features": 2},
    {"pose_shapes": "sparse", "pose_features": "quaternions", "shape_features": 1},
]


def words(variant):
    return "-".join(str(value) for value in variant.values())


def some(seed=0, noise=0.003, **changes):
    options = {
        "rank": 5,
        "l1": 0.01,
        "weights": EnergyWeights(joints=5.0, pose_shapes=0.5),
    } | changes
    problem, truth = planted(small=SMALL, seed=seed, each=4, noise=noise, **options)
    return problem, truth, disturbed(truth, seed)


@skinnings
@pytest.mark.parametrize("variant", VARIANTS, ids=words)
def test_no_step_raises_the_energy(skinning, variant):
    problem, _, estimate = some(skinning=skinning, **variant)
    first = before = measure_energy(problem, estimate, ALONE).total
    for _ in range(2):
        for name, step in STEPS.items():
            estimate = step(problem, estimate, ALONE)
            after = measure_energy(problem, estimate, ALONE).total
            assert after <= before * (1 + 1e-9), name
            before = after
    assert before < 0.2 * first


@skinnings
@pytest.mark.parametrize("variant", VARIANTS, ids=words)
def test_going_further_lowers_the_energy_and_keeps_what_was_asked_for(skinning, variant):
    problem, _, before = some(skinning=skinning, **variant)
    after = before
    for step in STEPS.values():
        after = step(problem, after, ALONE)
    known = measure_energy(problem, after, ALONE)
    further, energy = over_relax(problem, before, after, known, ALONE)
    assert energy == measure_energy(problem, further, ALONE) and (
        energy.total < known.total or further is after
    )
    assert further.rig.value.min() >= 0 and np.allclose(further.rig.value.sum(1), 1)
    assert np.array_equal(further.rig.index, after.rig.index)
    if "rank" in str(variant):
        flat = further.rig.posedirs.reshape(-1, further.rig.posedirs.shape[-1])
        assert np.linalg.matrix_rank(flat, tol=1e-9) <= problem.options.rank


def test_going_further_finds_the_minimum_along_a_line():
    """Halfway back from the truth the energy falls until it is passed; from the truth on it only
    rises.
    """
    problem, truth, start = some(noise=0.0, weights=EnergyWeights(pose_shapes=1e-9, joints=1e-9))
    halfway = replace(
        truth,
        **{
            key: (getattr(truth, key) + getattr(start, key)) / 2
            for key in ("templates", "joints", "trans")
        },
    )
    origin = replace(
        truth, **{key: getattr(start, key) for key in ("templates", "joints", "trans")}
    )
    found, energy = over_relax(
        problem, origin, halfway, measure_energy(problem, halfway, ALONE), ALONE
    )
    assert np.abs(found.templates - truth.templates).max() < 1e-12
    assert energy.total < 1e-6
    same, kept = over_relax(problem, halfway, found, energy, ALONE)
    assert same is found and kept is energy
    settings = TrainSettings(relaxation_factors=())
    still = replace(problem, options=replace(problem.options, settings=settings))
    energy = measure_energy(problem, halfway, ALONE)
    assert over_relax(still, origin, halfway, energy, ALONE) == (halfway, energy)


@skinnings
def test_each_step_lowers_the_energy_and_leaves_the_rest_alone(skinning):
    problem, _, estimate = some(skinning=skinning)
    parts = {
        subject_step: {"templates", "joints", "pose", "trans"},
        weight_step: {"value", "index"},
        pose_shape_step: {"posedirs"},
        pose_step: {"pose", "trans"},
    }
    assert set(parts) == {step.solve for step in STEPS.values()}
    before = measure_energy(problem, estimate, ALONE).total
    for step, own in parts.items():
        after = step(problem, estimate, ALONE)
        assert measure_energy(problem, after, ALONE).total < before * (1 - 1e-6)
        for key in ("templates", "joints", "descriptors", "pose", "trans"):
            assert np.array_equal(getattr(after, key), getattr(estimate, key)) == (key not in own)
        for key in ("index", "value", "posedirs"):
            same = np.array_equal(getattr(after.rig, key), getattr(estimate.rig, key))
            assert same if key not in own else not same or key == "index"


@skinnings
@pytest.mark.parametrize("kind", ["full", "l1"])
def test_each_step_lowers_the_sum_of_the_terms_that_it_names_and_no_other_term_changes(
    skinning, kind
):
    problem, _, estimate = some(skinning=skinning, pose_shapes=kind)
    for step in STEPS.values():
        terms = energy_terms(problem, estimate)
        takes = {name: term.bound(tuple(unknowns(estimate))).takes for name, term in terms.items()}
        assert set(step.terms) == {name for name in terms if set(takes[name]) & set(step.moves)}
        after = step(problem, estimate, ALONE)
        old, new = (costs(terms, unknowns(each)) for each in (estimate, after))
        assert sum(new[name] for name in step.terms) < sum(old[name] for name in step.terms)
        assert all(new[name] == old[name] for name in terms if name not in step.terms)
        for name, value in unknowns(estimate).items():
            assert name in step.moves or np.array_equal(value, unknowns(after)[name])
        estimate = after


@skinnings
def test_the_truth_stays_where_it_is_without_noise(skinning):
    problem, truth, _ = some(skinning=skinning, noise=0.0, weights=EnergyWeights(pose_shapes=1e-9))
    estimate = truth
    for step in (subject_step, weight_step, pose_shape_step, pose_step):
        estimate = step(problem, estimate, ALONE)
    assert measure_energy(problem, estimate, ALONE).terms["data"] < 1e-12
    assert np.abs(estimate.templates - truth.templates).max() < 1e-6
    assert np.abs(estimate.rig.weights - truth.rig.weights).max() < 1e-5
    assert np.abs(estimate.pose - truth.pose).max() < 1e-5


@skinnings
def test_alternation_leads_back_to_planted_registrations(skinning):
    problem, truth, estimate = some(
        skinning=skinning,
        pose_shapes="none",
        noise=0.0,
        weights=EnergyWeights(joints=1e-3, symmetry=1.0),
    )
    pose = estimate.pose.copy()
    for rows in (
        problem.rows_of(subject) for subject in range(problem.subjects)
    ):  # the zero pose is not sought
        pose[rows] = remove_mean_rotation(truth.rig.parents, truth.pose[rows], pose[rows])
    estimate = replace(estimate, pose=pose)
    for _ in range(10):
        before = estimate
        for step in STEPS.values():
            estimate = step(problem, estimate, ALONE)
        estimate, _ = over_relax(
            problem, before, estimate, measure_energy(problem, estimate, ALONE), ALONE
        )
    data = measure_energy(problem, estimate, ALONE).terms["data"]
    assert np.sqrt(data / len(problem.registrations) / len(SMALL.vertices)) < 1e-4  # m


def test_without_pose_blend_shapes_there_is_nothing_to_do():
    problem, _, estimate = some(pose_shapes="none")
    assert pose_shape_step(problem, estimate, ALONE) is estimate


def test_the_order_of_subjects_does_not_matter():
    problem, _, estimate = some(subjects=3)
    order = np.random.default_rng(1).permutation(len(problem.registrations))
    shuffled = replace(problem, registrations=problem.registrations.take(order))
    people = [
        problem.registrations.subjects.index(name) for name in shuffled.registrations.subjects
    ]
    mixed = replace(
        estimate,
        templates=estimate.templates[people],
        joints=estimate.joints[people],
        descriptors=estimate.descriptors[people],
        pose=estimate.pose[order],
        trans=estimate.trans[order],
    )
    for step in STEPS.values():
        estimate = step(problem, estimate, ALONE)
        mixed = step(shuffled, mixed, ALONE)
    assert np.abs(mixed.templates - estimate.templates[people]).max() < 1e-8
    assert np.abs(mixed.joints - estimate.joints[people]).max() < 1e-8
    assert np.abs(mixed.pose - estimate.pose[order]).max() < 1e-7
    assert np.abs(mixed.rig.posedirs - estimate.rig.posedirs).max() < 1e-8
    assert np.abs(mixed.rig.weights - estimate.rig.weights).max() < 1e-7


def test_subjects_have_rows_of_their_own():
    problem, _, estimate = some(subjects=3)
    assert sorted(np.concatenate([problem.rows_of(k) for k in range(problem.subjects)])) == list(
        range(12)
    )
    assert problem.rows_of(1).tolist() == [4, 5, 6, 7]
    assert np.array_equal(estimate.person(2).joints, estimate.joints[2])
