"""BlendSCAPE: rest, rigid motions, derivatives through the stitching, fits, and training on planted
deformations.
"""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from tube_body import random_pose
from worm_model import PARENTS, worm_model

from habitus.errors import HabitusError
from habitus.evaluate.generalisation import model_generalisation, pose_generalisation
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads
from habitus.rotations import matrix_from_rotvec
from habitus_lab.baselines.blendscape import BlendScape
from habitus_lab.baselines.blendscape_training import train_blendscape

NOISE = 0.002
LENGTH = NOISE * np.sqrt(8 / np.pi)  # mean length of the noise


@pytest.fixture(scope="module")
def worm() -> BlendScape:
    return worm_model(np.random.default_rng(0), shape=0.02, pose=0.1)


def test_rest_and_mean_give_the_template(worm):
    np.testing.assert_allclose(
        worm.surface(np.zeros(3), np.zeros((4, 3))), worm.template, atol=1e-12
    )
    np.testing.assert_allclose(
        worm.surface(np.zeros(0), np.zeros((4, 3))), worm.template, atol=1e-12
    )


def test_turning_the_root_turns_the_surface(worm):
    rng = np.random.default_rng(1)
    betas = rng.normal(size=3)
    pose = random_pose(rng, 4)
    mean = worm.template.mean(0)
    turned = pose.copy()
    pose[0] = 0.0
    turn = matrix_from_rotvec(torch.tensor(turned[0])).numpy()
    expected = (worm.surface(betas, pose) - mean) @ turn.T + mean
    np.testing.assert_allclose(worm.surface(betas, turned), expected, atol=1e-12)


def test_a_person_twice_as_large_is_twice_as_large_in_every_pose(worm):
    rng = np.random.default_rng(2)
    pose = random_pose(rng, 4)
    mean = worm.template.mean(0)
    large = replace(worm, mean_shape=2 * worm.mean_shape)
    once = worm.surface(np.zeros(0), pose)
    twice = large.surface(np.zeros(0), pose)
    np.testing.assert_allclose(twice - mean, 2 * (once - mean), atol=1e-12)


def test_columns_are_the_derivatives(worm):
    rng = np.random.default_rng(3)
    step = 1e-6
    x = np.concatenate([rng.normal(size=2), random_pose(rng, 4).ravel()])
    ((_, vertices, by),) = worm.columns(x[:2], x[2:].reshape(-1, 3), True)
    ((_, _, by_pose),) = worm.columns(x[:2], x[2:].reshape(-1, 3), False)
    np.testing.assert_allclose(vertices, worm.surface(x[:2], x[2:].reshape(-1, 3)), atol=1e-12)
    np.testing.assert_allclose(by[:, :, 2:], by_pose, atol=1e-12)
    for k in range(len(x)):
        ahead, behind = (
            worm.surface((x + d)[:2], (x + d)[2:].reshape(-1, 3))
            for d in np.outer([step, -step], np.eye(len(x))[k])
        )
        np.testing.assert_allclose(by[:, :, k], (ahead - behind) / (2 * step), atol=1e-8)


def test_it_travels_to_other_processes(worm):
    rng = np.random.default_rng(4)
    betas = rng.normal(size=3)
    pose = random_pose(rng, 4)
    made = worm.surface(betas, pose)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(worm)).surface(betas, pose), made)


@pytest.mark.parametrize("seed", range(3))
def test_it_reproduces_what_it_made_itself(worm, seed):
    rng = np.random.default_rng(seed)
    betas = rng.normal(size=3)
    pose = random_pose(rng, 4, 1.5)
    trans = rng.normal(size=3)
    fit = worm.fit(worm.surface(betas, pose) + trans, num_betas=3)
    np.testing.assert_allclose(fit.betas, betas, atol=1e-6)
    np.testing.assert_allclose(fit.pose, pose, atol=1e-6)
    np.testing.assert_allclose(fit.trans, trans, atol=1e-6)


def _planted(model, largest, noise, people=(8, 30, 3), poses=(16, 1, 3)):
    """Registrations of the three sets with their poses, and their true vertices; people of "shape"
    barely move.
    """
    rng = np.random.default_rng(5)
    clean = []
    turns = []
    words = []
    for key, persons, each in zip(("pose", "shape", "test"), people, poses, strict=True):
        for person in range(persons):
            betas = rng.normal(size=3)
            for _ in range(each):
                turns.append(random_pose(rng, 4, 0.2 if key == "shape" else largest))
                clean.append(model.surface(betas, turns[-1]) + rng.normal(size=3))
                words.append((f"{key}{person}", "", key, f"mesh {len(words)}"))
    noisy = np.array(clean) + noise * rng.normal(size=np.shape(clean))
    registrations = Registrations(noisy, model.faces, *zip(*words, strict=True))
    return registrations, np.array(turns), np.array(clean)


def _template(model):
    return Template(model.template, model.faces, model.influence.argmax(1), PARENTS, tuple("abcd"))


@pytest.fixture(scope="module")
def world(worm):
    return _planted(worm, 0.3, NOISE)


@pytest.fixture(scope="module")
def trained(worm, world):
    registrations, poses, _ = world
    return train_blendscape(registrations, _template(worm), poses, worm.influence, num_betas=6)


def test_training_reaches_the_noise_on_new_people_in_new_poses(trained, world):
    registrations, _, clean = world
    test = registrations.where(set="test")
    fitted = model_generalisation(trained, test, (0, 3, 6), clean=clean[-len(test) :])
    fixed = pose_generalisation(trained, test, fitted)
    assert fitted.means[0] > 2 * LENGTH and (np.diff(fitted.means) < 0).all()
    assert fitted.means[-1] < 1.15 * LENGTH and fixed.means[-1] < 1.25 * LENGTH
    assert fitted.clean_means[-1] < 0.65 * LENGTH


def test_deformations_by_pose_are_learned(worm, world, trained):
    registrations, poses, _ = world
    test = registrations.where(set="test")
    without = train_blendscape(
        registrations, _template(worm), poses, worm.influence, num_betas=6, sweeps=0
    )
    assert not without.pose_regression.any() and trained.pose_regression.any()
    errors = [
        pose_generalisation(m, test, model_generalisation(m, test, (6,))).means[0]
        for m in (without, trained)
    ]
    assert errors[1] < 0.8 * errors[0]


def test_triangles_hear_near_joints_or_all(trained):
    """At the ends of the worm, joints far away either count everywhere or nowhere."""
    heard = np.abs(trained.pose_regression).sum((2, 3)).reshape(3, 9, -1).sum(1) > 0
    head = trained.template[trained.faces].mean(1)[:, 0] > 0.65
    assert heard[2, head].all() and (heard[0, head].all() or not heard[0, head].any())


def test_people_at_rest_are_reproduced_exactly(worm):
    """Without poses nothing stands between a surface and its triangles; all coefficients give back
    every person.
    """
    rng = np.random.default_rng(6)
    surfaces = np.array([worm.surface(rng.normal(size=3), np.zeros((4, 3))) for _ in range(5)])
    words = [(f"p{k}", "", "shape", f"p{k}") for k in range(5)]
    registrations = Registrations(surfaces, worm.faces, *zip(*words, strict=True))
    model = train_blendscape(registrations, _template(worm), np.zeros((5, 4, 3)), worm.influence)
    assert model.num_betas <= 4
    for surface in surfaces:
        assert np.abs(model.fit(surface, num_betas=model.num_betas).vertices - surface).max() < 1e-6


def test_training_through_the_stitching_comes_nearer_in_strong_poses(worm):
    registrations, poses, _ = _planted(worm, 1.2, 0.0, people=(4, 0, 0), poses=(8, 1, 1))
    some = registrations.take(np.arange(0, 32, 8))
    errors = []
    for sweeps, extra in ((2, 0), (8, 0), (2, 6)):
        model = train_blendscape(
            registrations,
            _template(worm),
            poses,
            worm.influence,
            sweeps=sweeps,
            through_stitching=extra,
        )
        errors.append(model_generalisation(model, some, (3,)).means[0])
    assert errors[2] < 0.7 * min(errors[:2])


def test_threads_train_the_same_model(worm, world, trained):
    registrations, poses, _ = world
    again = train_blendscape(
        registrations, _template(worm), poses, worm.influence, num_betas=6, workers=Threads(2)
    )
    np.testing.assert_array_equal(again.pose_regression, trained.pose_regression)
    np.testing.assert_array_equal(again.shape_directions, trained.shape_directions)


def test_what_cannot_be_trained_on_is_refused(worm, world):
    registrations, poses, _ = world
    template = _template(worm)
    with pytest.raises(HabitusError, match="expected a pose for each registration"):
        train_blendscape(registrations, template, poses[1:], worm.influence)
    with pytest.raises(HabitusError, match="skinning weights have shape"):
        train_blendscape(registrations, template, poses, worm.influence[1:])
    with pytest.raises(HabitusError, match="same topology"):
        train_blendscape(
            registrations, replace(template, faces=worm.faces[::-1]), poses, worm.influence
        )
    with pytest.raises(HabitusError, match="at least two"):
        train_blendscape(registrations.take(np.array([0])), template, poses[:1], worm.influence)
