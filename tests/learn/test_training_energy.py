"""Every term of the energy is what the paper writes (S 4.1, eq. 14)."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import FLIP, JOINT_MIRROR, disturbed, planted, torch_surface

from habitus.body.skinning import SKINNING
from habitus.learn.energy import (
    asymmetry,
    costs,
    energy_terms,
    joints_term,
    measure_energy,
    normal_equations,
    regularizers,
    subject_terms,
    symmetry_term,
    unknowns,
)
from habitus.learn.options import EnergyWeights
from habitus.parallel.workers import Threads

WEIGHTS = EnergyWeights(
    symmetry=2.0, joint_symmetry=3.0, joints=5.0, pose_shapes=7.0, skinning=11.0
)
ALONE = Threads(1)


@pytest.mark.parametrize("skinning", list(SKINNING))
@pytest.mark.parametrize("kind", ["full", "sparse", "low_rank", "l1", "none"])
def test_terms_are_the_papers(skinning, kind):
    options = {
        "skinning": skinning,
        "pose_shapes": kind,
        "l1": 13.0,
        "weights": WEIGHTS,
        "shape_features": int(kind != "none"),
    }
    problem, truth = planted(each=20, **options)  # more than a block
    estimate = disturbed(truth)
    rng = np.random.default_rng(1)
    rig = replace(
        estimate.rig,
        value=rng.dirichlet(np.ones(4), len(estimate.rig.index)),
        posedirs=truth.rig.posedirs,
    )
    estimate = replace(estimate, rig=rig)
    data = 0.0
    for k, who in enumerate(problem.registrations.subject_index):
        person = estimate.templates[who], estimate.joints[who], estimate.descriptors[who]
        moved = torch_surface(rig, *person, estimate.pose[k]).numpy() + estimate.trans[k]
        data += (np.linalg.norm(problem.registrations.vertices[k] - moved, axis=1) ** 2).sum()
    mirror = problem.anatomy.mirror
    symmetry = sum(
        2 * np.linalg.norm(t - (t * FLIP)[mirror]) ** 2
        + 2 * 3 * np.linalg.norm(j - (j * FLIP)[JOINT_MIRROR]) ** 2
        for t, j in zip(estimate.templates, estimate.joints, strict=True)
    )
    regressor = problem.anatomy.regressor
    joints = sum(
        np.linalg.norm(regressor @ t - j) ** 2
        for t, j in zip(estimate.templates, estimate.joints, strict=True)
    )
    expected = {
        "data": data,
        "symmetry": symmetry,
        "joints": 5 * joints,
        "skinning": 11 * np.linalg.norm(rig.weights - problem.initial_weights) ** 2,
    }
    if kind != "none":
        own = (
            np.abs(rig.posedirs).sum() * 13
            if kind == "l1"
            else 7 * np.linalg.norm(rig.posedirs) ** 2
        )
        expected["pose_shapes"] = own
    energy = measure_energy(problem, estimate, ALONE)
    assert dict(energy.terms) == pytest.approx(expected, rel=1e-11)
    assert energy.total == pytest.approx(sum(expected.values()), rel=1e-11)
    assert min(expected.values()) > 0
    assert {"data": energy.terms["data"], **regularizers(problem, estimate)} == dict(energy.terms)
    told = costs(energy_terms(problem, estimate), unknowns(estimate))
    assert told == pytest.approx(dict(energy.terms), rel=1e-11)
    assert sum(told.values()) == pytest.approx(energy.total, rel=1e-11)


def test_planted_truth_without_noise_costs_only_its_blend_shapes():
    problem, truth = planted(weights=WEIGHTS)
    terms = dict(measure_energy(problem, truth, ALONE).terms)
    assert terms.pop("pose_shapes") > 0.01
    assert max(terms.values()) < 1e-20


def test_threads_measure_the_same():
    problem, truth = planted(each=40, noise=0.01)
    assert (
        measure_energy(problem, truth, Threads(2)).terms
        == measure_energy(problem, truth, ALONE).terms
    )


def of_one_subject(mirrored=True):
    """The terms of one subject in three spellings: whole, and on a sample with the ring fixed; and
    values.
    """
    problem, truth = planted(weights=WEIGHTS)
    anatomy = problem.anatomy
    rng = np.random.default_rng(3)
    mirrors = (anatomy.mirror, anatomy.joint_mirror) if mirrored else (None, None)
    anatomy = replace(anatomy, mirror=mirrors[0], joint_mirror=mirrors[1])
    count = rng.uniform(1, 3, len(truth.templates[0]))
    values = {"templates": truth.templates[0] + 0.01 * rng.normal(size=truth.templates[0].shape)}
    values["joints"] = truth.joints[0] + 0.01 * rng.normal(size=truth.joints[0].shape)
    sample = {"symmetry": symmetry_term(*mirrors, WEIGHTS, count)}
    sample["joints"] = joints_term(WEIGHTS, ring=truth.joints[0])
    return subject_terms(anatomy, WEIGHTS), sample, values


@pytest.mark.parametrize("mirrored", [True, False])
@pytest.mark.parametrize("which", [0, 1])
def test_normal_equations_are_the_derivatives_of_the_costs(which, mirrored):
    """Residuals are linear: half the second derivative is exact from finite steps."""
    terms = of_one_subject(mirrored)[which]
    values = of_one_subject(mirrored)[2]
    matrix, gradient = normal_equations(terms, values)
    assert np.allclose(matrix, matrix.T)
    rng = np.random.default_rng(4)
    along = {name: rng.normal(size=value.shape) for name, value in values.items()}
    flat = np.concatenate([each.ravel() for each in along.values()])
    here, ahead, behind = (
        sum(
            costs(terms, {name: value + t * along[name] for name, value in values.items()}).values()
        )
        for t in (0.0, 1.0, -1.0)
    )
    assert (ahead - behind) / 2 == pytest.approx(gradient @ flat, rel=1e-9)
    assert ahead + behind - 2 * here == pytest.approx(flat @ matrix @ flat, rel=1e-9)


def test_asymmetry_is_zero_for_what_is_symmetric():
    points = np.random.default_rng(5).normal(size=(len(JOINT_MIRROR), 3))
    both = points + points[JOINT_MIRROR] * FLIP
    assert np.abs(asymmetry(JOINT_MIRROR) @ both.ravel()).max() < 1e-14
    assert np.allclose(
        asymmetry(JOINT_MIRROR, 2.0) @ points.ravel(),
        2 * (points - points[JOINT_MIRROR] * FLIP).ravel(),
    )
