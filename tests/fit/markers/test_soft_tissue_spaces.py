"""The soft-tissue stage with dynamics: planted ones come back, held-out markers and files know
them.
"""

from dataclasses import replace

import numpy as np
import pytest
from marker_scene import scene
from planted import RATE_HZ, Recording, fit, fit_markers, person, plant, settings
from rigged_body import random_body
from soft_tubes import planted_regressor

import habitus
from habitus.body.dynamics import Dynamics
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export.npz import write_npz
from habitus.fit.markers.hold_out import held_out_errors
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import MoshSettings, SequenceSettings, settings_from
from habitus.io.people import read_fit
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach

HEIGHTS = (0.3, -0.25)  # m, of the middle of the trunk and the thighs on the template


@pytest.mark.parametrize("space", ["dynamics", "both"])
@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
def test_planted_soft_tissue_comes_back(space, skinning):
    s = scene(frames=10)
    rng = np.random.default_rng(1)
    body = random_body(0, joints=5, posedirs=False, betas=4)
    body = replace(
        body,
        skinning=skinning,
        dynamics=Dynamics(0.05 * rng.normal(size=(40, 3, 2)), planted_regressor()),
    )
    marked = marked_body(body, s.marked.betas, s.marked.attachment, space)
    truth = np.sin(np.arange(10))[:, None] * rng.normal(size=marked.num_betas)
    observed = predict(marked, s.pose, s.trans, truth)
    weak = SequenceSettings(pose=1e-3, acceleration=1e-3, soft_tissue=1e-4)
    found = fit_sequence(
        marked,
        observed,
        None,
        None,
        s.prior,
        s.pose,
        s.trans,
        weak,
        soft_tissue=np.zeros_like(truth),
    )
    np.testing.assert_allclose(found.soft_tissue, truth, atol=0.03)


def shaking() -> BodyModel:
    """The default body with dynamic blend shapes that no pose looks like: trunk and thighs swell by
    15 mm.
    """
    body = person()
    out = body.v_template * [1.0, 0.0, 1.0]
    out /= np.linalg.norm(out, axis=1, keepdims=True) + 0.02
    swell = [np.exp(-(((body.v_template[:, 1:2] - at) / 0.15) ** 2)) * out for at in HEIGHTS]
    known = replace(planted_regressor(), joints=("pelvis", "spine2", "left_knee"))
    return replace(body, dynamics=Dynamics(0.015 * np.stack(swell, -1), known), finer=None)


@pytest.fixture(scope="module")
def fitted():
    capture = plant(frames=24, seed=3)
    body = shaking()
    delta = 1.5 * np.sin(np.arange(24)[:, None] * [0.9, 1.3])
    attachment = attach(capture.latent_markers, body.rest_vertices(capture.betas), body.faces)
    marked = marked_body(body, capture.betas, attachment, "dynamics")
    moved = predict(marked, capture.pose, capture.trans, delta)
    chosen = settings(annealing=(10.0, 1.0), soft_space="dynamics")
    recording = Recording("shaking", moved, RATE_HZ, "+y")
    (found,) = fit_markers(body, capture.prior, capture.layout, [recording], chosen)
    return found, delta, moved, capture.layout


def test_the_recipe_finds_dynamics(fitted, tmp_path):
    found, delta, moved, layout = fitted
    assert found.dynamics.shape == (24, 2) and not found.soft_tissue.any()
    assert found.errors("soft_tissue").mean() < 0.7 * found.errors("pose").mean()
    assert np.corrcoef(found.dynamics[:, 0], delta[:, 0])[0, 1] > 0.8
    held = held_out_errors(found, layout, moved)
    assert held.soft_tissue.mean() < held.pose.mean()
    np.testing.assert_array_equal(
        found.vertices(7),
        found.body(
            found.betas, found.pose[7:8], found.trans[7:8], dynamics=found.dynamics[7:8]
        ).vertices[0],
    )
    write_npz(found, tmp_path / "body.npz")
    again = read_fit(tmp_path / "body.npz", found.body)
    np.testing.assert_array_equal(again.dynamics, found.dynamics)
    assert settings_from(again.settings).soft_space == "dynamics"


def test_its_terms_are_the_energy_that_was_minimised(fitted):
    found, *_ = fitted
    state = found.state(slice(0, 3))
    terms = found.terms(slice(0, 3))
    assert state.soft_tissue.shape == (3, 4 + 2)
    residual, jacobians = terms["data"].residual(state.pose, state.trans, state.soft_tissue)
    assert residual.shape[0] == 3 and jacobians()["soft_tissue"].shape[1] == 18


def test_a_body_without_dynamics_is_told_at_once():
    capture = plant(frames=6)
    capture = replace(capture, body=replace(capture.body, dynamics=None))
    with pytest.raises(HabitusError, match="no dynamic blend shapes"):
        fit(capture, which=replace(MoshSettings(), soft_space="both"))
    assert habitus.Mosh(soft_tissue="both").recipe_settings.soft_space == "both"
    assert habitus.Mosh(soft_tissue=False).recipe_settings == replace(
        MoshSettings(), soft_tissue=False
    )
    assert habitus.Mosh(soft_tissue=True).recipe_settings == MoshSettings()
