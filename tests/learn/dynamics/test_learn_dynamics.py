"""Planted dynamics are found: blend shapes, regressor, what the shape changes, soft tissue of
motions not seen.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from soft_people import soft_people
from soft_tubes import RATE, shaken, soft_tubes

from habitus.body.soft_tissue import simulate_soft_tissue
from habitus.errors import HabitusError
from habitus.evaluate.dynamics import evaluate_dynamics
from habitus.learn.dynamics.train import DynamicsOptions, learn_dynamics, swinging

OPTIONS = DynamicsOptions(
    components=2, rank=8, personal=False, shape_features=(0, 1), ridge=(1e-7, 1e-4)
)


@cache
def planted(controls="joints", skinning="lbs", noise=0.0):
    truth = soft_tubes(controls=controls, skinning=skinning)
    data = soft_people(truth, frames=120, noise=noise)
    learned = learn_dynamics(
        replace(truth, dynamics=None), data, replace(OPTIONS, controls=controls)
    )
    return truth, learned


@pytest.mark.parametrize(("controls", "skinning"), [("joints", "lbs"), ("smpl", "dqbs")])
def test_planted_dynamics_are_found(controls, skinning):
    truth, found = planted(controls, skinning)
    ours, theirs = (
        np.linalg.qr(b.dynamics.directions.reshape(-1, 2))[0] for b in (found.body, truth)
    )
    assert np.linalg.svd(ours.T @ theirs)[1].min() > 1 - 1e-6  # one span
    np.testing.assert_allclose(found.modes, swinging(truth.dynamics), rtol=1e-2)
    assert (
        found.shares.sum() > 0.999
        and found.choices[0].shape_features == 1
        and found.choices[0].error < 0.03
    )
    motion = shaken(150, seed=77)
    betas = np.array([0.2, 0.1, 0, 0])
    surfaces = []
    for body in (found.body, truth):
        delta = simulate_soft_tissue(body, betas, *motion, RATE)
        surfaces.append(body(betas, *motion, dynamics=delta).vertices)
    without = truth(betas, *motion).vertices
    assert np.std(surfaces[0] - surfaces[1]) < 0.1 * np.std(without - surfaces[1])


def test_noise_of_registrations_does_little_harm():
    """12 mm on every coordinate: least squares alone finds motions that die down too fast."""
    truth, found = planted(noise=0.012)
    best = found.choices[0]
    plain = min(choice.error for choice in found.choices if choice.rounds == 0)
    assert best.rounds > 0 and best.error < 0.05 < plain
    np.testing.assert_allclose(found.modes, swinging(truth.dynamics), rtol=0.15)


def test_motions_that_were_not_seen_are_told_as_in_the_paper():
    truth, found = planted()
    (errors,) = evaluate_dynamics(
        found.body, soft_people(truth, people=1, sequences=1, frames=80, seed=4)
    )
    without, simulated, fitted = errors.errors
    assert (simulated < 0.25 * without).all() and (fitted < 0.01 * without).all()
    assert (
        errors.simulated.shape == (80,) and np.corrcoef(errors.simulated, errors.fitted)[0, 1] > 0.9
    )
    (stiff,) = evaluate_dynamics(
        found.body, soft_people(truth, people=1, sequences=1, frames=80, seed=4), strength=0.0
    )
    np.testing.assert_allclose(stiff.errors[1], without, rtol=1e-9)


def test_errors_are_those_of_the_definition():
    truth, found = planted()
    (one,) = soft_people(truth, people=1, sequences=1, frames=70, seed=5)
    (errors,) = evaluate_dynamics(found.body, [one])
    wrong = truth(one.betas, one.pose, one.trans).vertices - one.registrations.vertices
    rms = lambda x: np.sqrt((x**2).sum(-1).mean())  # noqa: E731
    speed = 0.5 * RATE * (wrong[2:] - wrong[:-2])
    force = RATE**2 * np.diff(wrong, 2, axis=0)
    np.testing.assert_allclose(
        errors.errors[0], [1e3 * rms(wrong), 1e3 * rms(speed), rms(force)], rtol=1e-9
    )


def test_a_persons_own_form_is_no_dynamics():
    """People who only swing in one way, each with bumps of 10 mm that the body's shapes do not
    have.
    """
    truth = soft_tubes()
    rng = np.random.default_rng(0)
    bare = replace(truth, dynamics=None)
    swing = np.sin(np.arange(60) / 5)[:, None, None]
    data = []
    for one in soft_people(truth, frames=60, sequences=1):
        own = 0.01 * rng.normal(size=(300, 3)) + swing * truth.dynamics.directions[..., 0]
        meshes = replace(one.registrations, vertices=bare(one.betas).vertices + own)
        data.append(
            replace(one, registrations=meshes, pose=np.zeros((60, 10, 3)), trans=np.zeros((60, 3)))
        )
    found = learn_dynamics(bare, data, replace(OPTIONS, components=1, personal=True)).body
    ours, theirs = (body.dynamics.directions[..., 0].ravel() for body in (found, truth))
    assert abs(ours @ theirs) > 0.999 * np.linalg.norm(ours) * np.linalg.norm(theirs)


def test_one_sequence_alone_is_held_out_in_pieces():
    (one,) = soft_people(soft_tubes(), people=1, sequences=1, frames=160)
    found = learn_dynamics(replace(soft_tubes(), dynamics=None), [one], OPTIONS)
    assert found.choices[0].shape_features == 0 and found.choices[0].error < 1
    assert [len(course) for course in found.coefficients] == [160]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"controls": "wind"}, "controls are 'wind'; expected one of joints, smpl"),
        ({"components": 0}, "0 components"),
        ({"ridge": (0.0,)}, "ridge"),
        ({"shape_features": ()}, "shape_features"),
    ],
)
def test_options_that_make_no_sense(options, told):
    with pytest.raises(HabitusError, match=told):
        DynamicsOptions(**options)
