"""Model and pose generalisation: planted people, what must not get worse, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from tube_body import random_pose, tube_body

from habitus.errors import HabitusError
from habitus.evaluate.generalisation import model_generalisation, pose_generalisation
from habitus.evaluate.posable import PosableBody, without_pose_shapes
from habitus.mesh.registrations import Registrations
from habitus.parallel.workers import Threads

NOISE = 0.002


@pytest.fixture(scope="module")
def world():
    """Two people in three poses each and one in one, with noise and without."""
    rng = np.random.default_rng(0)
    body = tube_body(betas=6, around=5, along=3, pose_shapes=0.002)
    model = PosableBody(body)
    subjects = ("ann", "bob", "ann", "bob", "ann", "bob", "eve")
    betas = {name: rng.normal(size=6) for name in ("ann", "bob", "eve")}
    clean = np.array(
        [
            model.surface(betas[s], random_pose(rng, largest=0.8)) + rng.normal(size=3)
            for s in subjects
        ]
    )
    noisy = clean + NOISE * rng.normal(size=clean.shape)
    names = tuple(f"{s}_{k}" for k, s in enumerate(subjects))
    sets = ("test",) * len(subjects)
    return model, Registrations(noisy, body.faces, subjects, ("",) * 7, sets, names), clean


@pytest.fixture(scope="module")
def curves(world):
    model, registrations, clean = world
    fitted = model_generalisation(model, registrations, (0, 3, 6, 50), clean=clean)
    return fitted, pose_generalisation(model, registrations, fitted, clean=clean)


def test_more_coefficients_never_fit_worse(curves):
    fitted, _ = curves
    assert fitted.counts == (0, 3, 6)
    assert (np.diff(fitted.errors, axis=0) < 1e-3).all() and (np.diff(fitted.means) < 0).all()


def test_all_coefficients_reach_the_noise_and_see_through_it(curves):
    fitted, fixed = curves
    expected = NOISE * np.sqrt(8 / np.pi)  # mean length of a Gaussian vector
    assert 0.75 * expected < fitted.means[-1] < expected
    assert fitted.clean_means[-1] < 0.75 * fitted.means[-1]
    assert fixed.clean_means[-1] < 1.5 * expected


def test_a_shape_from_elsewhere_fits_no_better_than_its_own(curves):
    fitted, fixed = curves
    own = fitted.errors[:, [fitted.registrations.index(name) for name in fixed.registrations]]
    assert (fixed.errors > own - 2e-4).all() and (fixed.errors.mean(1) > own.mean(1)).any()


def test_the_first_registration_of_each_person_gives_the_shape(curves):
    fitted, fixed = curves
    assert fixed.registrations == ("ann_2", "bob_3", "ann_4", "bob_5")
    for n, subject in enumerate(fixed.subjects):
        np.testing.assert_array_equal(
            fixed.betas[:, n], fitted.betas[:, fitted.subjects.index(subject)]
        )


def test_means_over_vertices_and_registrations_agree(curves, world):
    for curve in curves:
        np.testing.assert_allclose(curve.per_vertex.mean(1), curve.means)
        np.testing.assert_allclose(curve.clean_per_vertex.mean(1), curve.clean_means)
    fitted, (model, registrations, _) = curves[0], world
    vertices = model.surface(fitted.shape(2, 2), fitted.pose[2, 2]) + fitted.trans[2, 2]
    distance = np.linalg.norm(vertices - registrations.read(2), axis=1).mean()
    np.testing.assert_allclose(distance, fitted.errors[2, 2])


def test_plain_skinning_is_worse_where_poses_deform(world, curves):
    model, registrations, _ = world
    plain = PosableBody(without_pose_shapes(model.body), label="plain")
    fitted = model_generalisation(plain, registrations, (6,))
    fixed = pose_generalisation(plain, registrations, fitted)
    assert (
        fitted.means[0] > 1.2 * curves[0].means[-1] and fixed.means[0] > 1.2 * curves[1].means[-1]
    )


def test_wherever_fits_are_made_they_are_the_same(world):
    model, registrations, _ = world
    some = registrations.take(np.arange(3))
    threads = model_generalisation(model, some, (2,), workers=Threads(2))
    np.testing.assert_array_equal(threads.errors, model_generalisation(model, some, (2,)).errors)


def test_what_cannot_be_measured_is_refused(world, curves):
    model, registrations, clean = world
    with pytest.raises(HabitusError, match="no registrations"):
        model_generalisation(model, registrations.take(np.array([], int)))
    with pytest.raises(HabitusError, match="none below 0"):
        model_generalisation(model, registrations, (-1,))
    with pytest.raises(HabitusError, match="clean vertices"):
        model_generalisation(model, registrations, clean=clean[1:])
    with pytest.raises(HabitusError, match="expected model generalisation of tubes"):
        pose_generalisation(model, registrations, curves[1])
    alone = replace(registrations, subject=tuple("abcdefg"))
    with pytest.raises(HabitusError, match="several poses"):
        pose_generalisation(model, alone, curves[0])


def test_what_was_not_observed_does_not_count(world, curves):
    """Weights of 0, with whatever is stored there: NaN, or what a registration continued."""
    model, registrations, _ = world
    rng = np.random.default_rng(1)
    weights = np.where(rng.random(registrations.vertices.shape[:2]) < 0.2, 0.0, 1.0)
    weights[:, 0] = 0.0
    for stored in (np.nan, 9.0):
        vertices = np.where(weights[..., None] > 0.0, registrations.vertices, stored)
        some = replace(registrations, vertices=vertices, weights=weights)
        fitted = model_generalisation(model, some, (6,))
        fixed = pose_generalisation(model, some, fitted)
        assert 0.9 < fitted.means[0] / curves[0].means[-1] < 1.1
        assert 0.8 < fixed.means[0] / curves[1].means[-1] < 1.2
        assert np.isnan(fitted.per_vertex[0, 0]) and np.isfinite(fitted.per_vertex[0, 1:]).all()


def test_a_weight_counts_like_so_many_registered_vertices(world):
    """Halving all weights changes nothing."""
    model, registrations, _ = world
    one = registrations.take(np.arange(2))
    half = replace(one, weights=np.full(registrations.num_vertices, 0.5))
    found = [model_generalisation(model, each, (3,)).errors for each in (one, half)]
    np.testing.assert_allclose(*found, rtol=1e-4)
