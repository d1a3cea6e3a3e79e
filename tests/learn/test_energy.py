"""Every term of the energy is what the paper writes (S 4.1, eq. 14)."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import FLIP, JOINT_MIRROR, disturbed, planted, torch_surface

from habitus.body.skinning import SKINNING
from habitus.learn.energy import measure_energy, regularizers
from habitus.learn.options import EnergyWeights
from habitus.parallel.workers import Threads

WEIGHTS = EnergyWeights(symmetry=2.0, joint_symmetry=3.0, joints=5.0, pose_shapes=7.0, skinning=11.0)
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
    rig = replace(estimate.rig, value=rng.dirichlet(np.ones(4), len(estimate.rig.index)), posedirs=truth.rig.posedirs)
    estimate = replace(estimate, rig=rig)
    data = 0.0
    for k, who in enumerate(problem.registrations.subject_index):
        person = estimate.templates[who], estimate.joints[who], estimate.descriptors[who]
        moved = torch_surface(rig, *person, estimate.pose[k]).numpy() + estimate.trans[k]
        data += (np.linalg.norm(problem.registrations.vertices[k] - moved, axis=1) ** 2).sum()
    mirror = problem.anatomy.mirror
    symmetry = sum(
        2 * np.linalg.norm(t - (t * FLIP)[mirror]) ** 2 + 2 * 3 * np.linalg.norm(j - (j * FLIP)[JOINT_MIRROR]) ** 2
        for t, j in zip(estimate.templates, estimate.joints, strict=True)
    )
    regressor = problem.anatomy.regressor
    joints = sum(
        np.linalg.norm(regressor @ t - j) ** 2 for t, j in zip(estimate.templates, estimate.joints, strict=True)
    )
    expected = {
        "data": data,
        "symmetry": symmetry,
        "joints": 5 * joints,
        "skinning": 11 * np.linalg.norm(rig.weights - problem.initial_weights) ** 2,
    }
    if kind != "none":
        own = np.abs(rig.posedirs).sum() * 13 if kind == "l1" else 7 * np.linalg.norm(rig.posedirs) ** 2
        expected["pose_shapes"] = own
    energy = measure_energy(problem, estimate, ALONE)
    assert dict(energy.terms) == pytest.approx(expected, rel=1e-11)
    assert energy.total == pytest.approx(sum(expected.values()), rel=1e-11)
    assert min(expected.values()) > 0
    assert {"data": energy.terms["data"], **regularizers(problem, estimate)} == dict(energy.terms)


def test_planted_truth_without_noise_costs_only_its_blend_shapes():
    problem, truth = planted(weights=WEIGHTS)
    terms = dict(measure_energy(problem, truth, ALONE).terms)
    assert terms.pop("pose_shapes") > 0.01
    assert max(terms.values()) < 1e-20


def test_threads_measure_the_same():
    problem, truth = planted(each=40, noise=0.01)
    assert measure_energy(problem, truth, Threads(2)).terms == measure_energy(problem, truth, ALONE).terms
