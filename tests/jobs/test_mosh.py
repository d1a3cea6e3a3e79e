"""`habitus.Mosh`: one capture gives a fit, a list a list; options reach the recipe; a live fit
follows its markers.
"""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import habitus as hb
from habitus.body.prior import PosePrior, prior_of, shipped_prior
from habitus.errors import HabitusError
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

FRAMES = 60


HASTY = MoshSettings(annealing=(10.0,), frames=3)
"""A hasty shape stage: these tests ask what goes where, not how well the body fits."""


@pytest.fixture(scope="module")
def body():
    return hb.load_body("default")


@pytest.fixture(scope="module")
def truth(body):
    rng = np.random.default_rng(5)
    layout = load_layout("cmu-41")
    prior = shipped_prior().for_joints(body.joint_names)
    betas = np.clip(rng.normal(size=body.num_betas), -2, 2)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), FRAMES, 120.0, rng)
    return simulate_capture(
        body, betas, pose, trans, layout.vertices(body), layout.distances(), Faults(), rng
    )


@pytest.fixture(scope="module")
def capture(truth) -> Capture:
    return Capture("walk", load_layout("cmu-41").labels, truth.observed, 120.0, "+y")


def test_one_capture_is_a_fit_and_a_list_is_a_list(body, capture, tmp_path):
    recipe = hb.Mosh(soft_tissue="none", settings=HASTY, sex="auto")
    fit = recipe.fit(capture, body)
    (again,) = recipe.fit([capture], body, out=tmp_path)
    np.testing.assert_array_equal(fit.pose, again.pose)
    assert {path.name for path in (tmp_path / "walk").iterdir()} == {
        "body.npz",
        "body.glb",
        "metrics.json",
        "report.html",
    }
    assert "href='walk/report.html'" in (tmp_path / "index.html").read_text("utf-8")
    page = (tmp_path / "walk" / "report.html").read_text("utf-8")
    assert set(re.findall(r"<a href='([^']*)'", page)) == {"body.npz", "body.glb", "metrics.json"}
    assert any("sex auto" in warning for warning in fit.warnings)
    read = hb.load_fit(tmp_path / "walk" / "body.npz")
    np.testing.assert_allclose(read.vertices([0, 9]), fit.vertices([0, 9]), atol=1e-5)


def test_a_file_and_its_capture_are_the_same(body, capture, tmp_path):
    write_c3d(capture, tmp_path / "walk.c3d")
    recipe = hb.Mosh(soft_tissue="none", settings=HASTY, fps=60.0)
    fit, again = (
        recipe.fit(one, body)
        for one in (tmp_path / "walk.c3d", hb.read_capture(tmp_path / "walk.c3d"))
    )
    np.testing.assert_array_equal(fit.pose, again.pose)
    assert fit.rate_hz == again.rate_hz == 60.0


def test_weights_change_the_fit(body, capture):
    loose, stiff = (
        hb.mosh(
            capture,
            body=body,
            soft_tissue="none",
            settings=HASTY,
            weights=hb.MoshWeights(acceleration=weight),
        )[0]
        for weight in (0.0, 1e4)
    )
    shaking = [np.abs(np.diff(fit.pose[:, 1:], 2, axis=0)).mean() for fit in (loose, stiff)]
    assert shaking[1] < 0.5 * shaking[0]


def test_held_out_markers_by_one_or_by_two_workers(body, capture):
    alone, shared = (
        hb.Mosh(soft_tissue="none", settings=HASTY, hold_out_every=2).fit(
            capture[:10], body, workers=workers
        )
        for workers in (None, 2)
    )
    assert set(alone.held_out.labels) == set(capture.labels)
    np.testing.assert_allclose(alone.held_out.pose, shared.held_out.pose, atol=1e-9)


def test_a_body_with_a_prior_of_its_own_is_fitted_with_it(body, capture, monkeypatch):
    names = body.joint_names[1:]
    own = PosePrior(names, np.zeros(3 * len(names)), 1e-8 * np.eye(3 * len(names)))
    assert prior_of(SimpleNamespace(pose_prior=own)) is own and prior_of(body).joint_names
    monkeypatch.setattr("habitus.jobs.mosh.prior_of", lambda given: own)
    fit = hb.Mosh(soft_tissue="none", settings=HASTY).fit(capture[:8], body)
    assert np.abs(fit.pose[:, 1:]).max() < 1e-2


def test_a_live_fit_follows_its_markers(body, capture, truth):
    live = hb.Mosh(settings=HASTY).start(capture[:40], body)
    assert live.labels == capture.labels
    assert np.isnan(live.step(np.full((len(capture.labels), 3), np.nan)).pose).all()
    frames = [live.step(markers) for markers in capture.markers[40:]]
    off = np.linalg.norm(np.stack([frame.trans for frame in frames]) - truth.trans[40:], axis=1)
    assert off.mean() < 0.05
    with pytest.raises(HabitusError, match="one row a label"):
        live.step(capture.markers[0, :5])


def test_a_slice_of_a_capture(capture):
    assert len(capture) == FRAMES and len(capture[10:30]) == 20
    assert capture[::2].rate_hz == 60.0
    with pytest.raises(HabitusError, match="slice"):
        capture[3]


def test_genders_that_are_none_and_models_that_a_body_has_not(body, capture):
    with pytest.raises(HabitusError, match="sex is 'other'; expected one of neutral, female"):
        hb.Mosh(sex="other")
    foreign = replace(body, name="smplh")
    with pytest.raises(HabitusError, match="smplh has no male model"):
        hb.Mosh(sex="male").fit(capture, foreign)


def test_no_capture_at_all(body):
    with pytest.raises(HabitusError, match="no capture was given"):
        hb.Mosh().fit([], body)
