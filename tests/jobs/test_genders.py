"""Which model of the body a person is fitted with: the one asked for, told by the file, or sure
from the markers.
"""

from types import SimpleNamespace

import numpy as np

import habitus as hb
from habitus.body.gender import said_of
from habitus.body.prior import prior_of
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.jobs.bodies import choose_sex, of_sex
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

QUICK = MoshSettings(annealing=(10.0,), frames=3, soft_tissue=False)


def walk(whose: str, seed: int, betas: np.ndarray | None = None, **recorded: str) -> Capture:
    """A made-up capture of somebody of a sex."""
    body = load_body(whose)
    layout = load_layout("cmu-41")
    rng = np.random.default_rng(seed)
    prior = prior_of(body).for_joints(body.joint_names)
    shape = rng.normal(size=body.num_betas).clip(-2, 2) if betas is None else betas
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), 20, 60.0, rng)
    places = layout.vertices(body), layout.distances()
    truth = simulate_capture(body, shape, pose, trans, *places, Faults(), rng)
    return Capture("walk", layout.labels, truth.observed, 60.0, "+y", recorded=recorded)


def test_auto_takes_the_sex_that_it_is_sure_of_and_says_so():
    fit = hb.Mosh(sex="auto", soft_tissue="none", settings=QUICK).fit(
        walk("male", 3, np.zeros(1)), "default"
    )
    probability = fit.female_probability
    assert probability is not None and probability < 0.5
    assert fit.gender == {"undecided": "neutral"}.get(said_of(probability), "male")
    assert fit.body.name == {"neutral": "default"}.get(fit.gender, fit.gender)
    assert sum("sex auto" in warning for warning in fit.warnings) == 1


def test_a_model_that_is_asked_for_is_fitted(tmp_path):
    fit = hb.Mosh(sex="female", soft_tissue="none", settings=QUICK).fit(
        walk("female", 1), "default", out=tmp_path
    )
    assert (fit.gender, fit.body_name, fit.female_probability) == ("female", "female", None)
    read = hb.load_fit(tmp_path / "walk" / "body.npz")
    assert read.gender == "female" and read.body.name == "female"
    np.testing.assert_allclose(read.vertices(0), fit.vertices(0), atol=1e-5)


def test_a_file_that_says_the_sex_is_believed():
    person = SimpleNamespace(captures=(walk("male", 1, sex="male"), walk("male", 2)))
    found = choose_sex(load_body("default"), "auto", person, QUICK, lambda stage, share: None)
    assert found.sex == found.body.name == "male" and "file says male" in found.notes[0]


def test_models_of_a_sex_are_like_the_neutral_one_in_all_else():
    body = load_body("default").with_betas(7)
    for sex in ("female", "male"):
        found = of_sex(body, sex)
        assert (found.num_betas, found.joint_names) == (7, body.joint_names)
        assert found.num_vertices == body.num_vertices and list(found.landmarks) == list(
            body.landmarks
        )
    assert of_sex(body, "neutral") is body
