"""A body from some measurements: it has them, is the likeliest that does, and says what is left
open.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.fit.from_measurements import ESTIMATE, estimate_body, measurement_terms
from habitus.io.models.bodies import load_body, save_body


@pytest.fixture(scope="module")
def body():
    mean = np.array([0.1, -0.2, 0.3, 0.0, -0.4, 0.5, 0.2, -0.3])
    return replace(load_body("default").with_betas(8), people_mean=mean)


def test_the_body_has_what_was_asked_for(body):
    asked = {"height": 1.78, "weight": 80.0, "waist": 0.88}
    found = estimate_body(body, asked)
    measured = body.measure(found.betas)
    assert found.measurements == pytest.approx(measured)
    for name, value in {"height_m": 1.78, "mass_kg": 80.0, "waist_circumference_m": 0.88}.items():
        assert measured[name] == pytest.approx(value, rel=2e-3) and found.given[name] == value
        assert found.spread[name] < 0.01 * value


def test_nobody_who_measures_so_is_likelier(body):
    found = estimate_body(body, {"height": 1.78, "weight": 80.0})
    rng = np.random.default_rng(0)
    names = list(found.given)
    values = np.array([found.given[name] for name in names])

    def unlikely(betas):
        off = (np.array([body.measure(betas)[name] for name in names]) - values) / (0.002 * values)
        return np.sum((betas - body.people_mean) ** 2) + off @ off

    least = unlikely(found.betas)
    assert all(unlikely(found.betas + 0.05 * rng.normal(size=8)) > least - 1e-3 for _ in range(20))


def test_the_spread_is_that_of_people_who_measure_so(body):
    """Of many people drawn at random, those of that height and weight are as different as was
    said.
    """
    rng = np.random.default_rng(1)
    people = body.people_mean + rng.normal(size=(300, 8))
    measured = body.measure_people(people)
    found = estimate_body(body, {"height": (1.70, 0.05), "weight": (78.0, 7.0)})
    weight = np.exp(
        -0.5 * ((measured["height_m"] - 1.70) / 0.05) ** 2
        - 0.5 * ((measured["mass_kg"] - 78) / 7) ** 2
    )
    for name in ("chest_circumference_m", "waist_circumference_m", "inseam_m"):
        mean = np.average(measured[name], weights=weight)
        sd = np.sqrt(np.average((measured[name] - mean) ** 2, weights=weight))
        assert found.spread[name] == pytest.approx(sd, rel=0.35), name
        assert found.measurements[name] == pytest.approx(mean, abs=0.3 * sd), name


def test_what_is_told_leaves_less_open(body):
    nothing, some, more = (
        estimate_body(body, given) for given in ({}, {"height": 1.8}, {"height": 1.8, "hip": 1.0})
    )
    assert (
        np.array_equal(nothing.betas, body.people_mean)
        and np.allclose(nothing.betas_sd, 1)
        and nothing.sd_from_mean == 0
    )
    for name in nothing.spread:
        assert (
            more.spread[name] <= some.spread[name] * 1.1 + 1e-3 <= nothing.spread[name] * 1.3 + 3e-3
        )


def test_the_less_sure_a_value_the_less_it_weighs(body):
    sure, unsure = (estimate_body(body, {"height": (1.9, sd)}) for sd in (0.001, 0.2))
    mean = body.measure(body.people_mean)["height_m"]
    assert sure.measurements["height_m"] == pytest.approx(1.9, abs=1e-3)
    assert mean < unsure.measurements["height_m"] < 1.8


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"height": 1.78, "weight": 20}, r"\d+ standard deviations from the people"),
        ({"height": 178}, r"height is 178; people have about 1\.\d+: give metres"),
        ({"weight": -3}, "weight is -3; expected a number above 0"),
        ({"height": float("nan")}, "expected a number above 0"),
        ({"hieght": 1.7}, "no measurement 'hieght'; expected one such as height"),
        ({"height": 1.7, "stature": 1.7}, "given twice"),
        ({"height": (1.7, 0.01, 3)}, "expected a number above 0, or such a number and its sd"),
    ],
)
def test_what_cannot_be_is_told(body, told, words):
    with pytest.raises(HabitusError, match=words):
        estimate_body(body, told)


def test_rare_people_are_said_to_be_rare(body):
    found = estimate_body(body, {"height": 1.55, "weight": 110.0})
    assert 2.5 < found.sd_from_mean < ESTIMATE.max_sd
    assert estimate_body(body, {"height": 1.70}).sd_from_mean < 0.3


def test_the_mean_person_goes_with_the_body(body, tmp_path):
    few = replace(body.with_betas(3), finer=None, people_mean=np.array([0.5, -1.0, 0.25]))
    save_body(few, tmp_path / "few.npz")
    read = load_body(tmp_path / "few.npz")
    assert np.array_equal(read.people_mean, few.people_mean) and read.with_betas(
        2
    ).people_mean.tolist() == [0.5, -1.0]
    assert np.array_equal(estimate_body(read, {}).betas, few.people_mean)
    assert replace(few, ages=body.ages).at_age(8).people_mean is None
    template = estimate_body(replace(few, people_mean=None), {})
    assert not template.betas.any() and template.sd_from_mean == 0


@pytest.mark.parametrize(
    ("sex", "height", "mass", "waist"),
    [("female", 1.629, 67.7, 0.862), ("male", 1.756, 81.0, 0.905)],
)
def test_people_of_mean_height_and_mass_have_the_waists_of_the_survey(sex, height, mass, waist):
    """Means of civilians drawn from ANSUR II (`lab/src/habitus_lab/default_body/population.py`);
    bodies with the survey's girths are 1 to 2 kg light, so those of its mass are wider.
    """
    found = estimate_body(load_body(sex), {"height": height, "weight": mass})
    assert found.measurements["waist_circumference_m"] == pytest.approx(waist, abs=0.025)


@pytest.mark.parametrize(
    ("space", "asked"),
    [
        ("neutral", {"height": 1.82, "waist": 0.95}),
        ("female", {"height": 1.62, "weight": 58.0}),  # extremes and hulls have kinks
        ("male", {"height": 1.74, "weight": 92.0, "chest": 1.08}),
    ],
)
def test_the_solve_says_how_it_ended_and_no_step_away_is_cheaper(space, asked):
    body = load_body(space)
    found = estimate_body(body, asked)
    assert found.status == "converged"
    names = list(found.measurements)
    rows = [names.index(name) for name in found.given]
    values = np.array([*found.given.values()])
    terms = measurement_terms(body, rows, values, ESTIMATE.precision * values)

    def cost(betas):
        return sum(term({"betas": betas}).cost for term in terms.values())

    best = cost(found.betas)
    for step in 0.02 * np.eye(len(found.betas))[:4]:
        assert cost(found.betas + step) > best and cost(found.betas - step) > best
