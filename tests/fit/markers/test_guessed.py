"""What no marker tells is guessed: that, then and there, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit

from habitus.fit.markers.solution import UNCERTAINTY


@pytest.fixture(scope="module")
def fit():
    return synthetic_fit(frames=48, markers=110, soft=False, suspects=())


def without(fit, joint, frames=slice(None)):
    """Markers beside a limb are not trusted in some frames."""
    places = np.asarray(fit.body.joint_template)[fit.body.joint_names.index(joint)]
    away = fit.latent_markers[:, 0] * np.sign(places[0]) > abs(places[0]) - 0.02
    weights = fit.marker_weights.copy()
    weights[frames, :] *= ~away
    assert 3 < away.sum() < 40
    return replace(fit, marker_weights=weights)


def test_where_markers_are_nothing_is_guessed(fit):
    edges, spread = fit.guessed
    assert len(edges) == 24 and spread.shape == (24, 24) and not fit.guessed.joints().any()
    assert (
        spread[spread > 0].min() > 0.005
    )  # no part is known better than markers sit where they should


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_limb_without_markers_is_guessed(fit, side):
    guessed = without(fit, f"{side}_shoulder").guessed
    names = {
        name for name, guess in zip(fit.body.joint_names, guessed.joints(), strict=True) if guess
    }
    assert names == {
        f"{side}_shoulder",
        f"{side}_elbow",
        f"{side}_wrist",
    }  # hands and feet of tubes carry no skin


def test_for_as_long_as_nobody_sees_it(fit):
    edges, spread = without(fit, "left_shoulder", slice(16, 32)).guessed
    hidden = (edges >= 16) & (edges < 32)
    elbow = spread[:, fit.body.joint_names.index("left_elbow")] > UNCERTAINTY.guessed
    np.testing.assert_array_equal(elbow, hidden)


def test_more_markers_never_tell_less(fit):
    few = np.where(np.arange(len(fit.labels)) % 5 == 0, 1.0, 0.0) * fit.marker_weights
    assert (replace(fit, marker_weights=few).guessed.spread >= fit.guessed.spread - 1e-9).all()


def test_without_any_marker_all_is_guessed(fit):
    blind = replace(fit, marker_weights=np.zeros_like(fit.marker_weights))
    skin = fit.guessed.spread > 0  # some joints carry none
    assert 15 * skin.shape[0] < skin.sum() and (blind.guessed.spread[skin] > 1).all()
