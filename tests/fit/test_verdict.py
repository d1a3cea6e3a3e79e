"""Verdicts: the worst level decides, limits of people depend on age, sentences are filled in."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from habitus.fit.verdict import (
    ADULTS,
    ADULTS_MEAN,
    ADULTS_WHITENING,
    BODY,
    DOUBTFUL,
    FAILED,
    GOOD,
    HANDS,
    HEAD,
    LEVELS,
    PARTS,
    PEOPLE,
    Bound,
    PeopleLimits,
    Reason,
    Verdict,
    above,
    below,
    enumerated,
    measured,
    measurement_reasons,
    part_of_joint,
    percent,
    proportion_reasons,
    verdict_of,
    weigh,
    words,
    worst,
)
from habitus.io.models.bodies import load_body

SENTENCES = {"a": "{x:.1f} m.", "b": "B.", "c": "C."}


@given(st.lists(st.sampled_from(LEVELS)))
def test_the_worst_level_decides_and_reasons_come_by_gravity(levels):
    found = verdict_of([Reason(level, "b") for level in levels], SENTENCES)
    assert found.level == worst(levels)
    assert len(found.reasons) == len(levels)


def test_reasons_of_one_level_keep_the_order_of_the_checks():
    checks = [
        lambda evidence, limits: [Reason(GOOD, "a", {"x": evidence})],
        lambda evidence, limits: [Reason(FAILED, "b"), Reason(above(evidence, limits), "c")],
    ]
    found = weigh(checks, 3.0, Bound(1.0, 4.0), SENTENCES)
    assert found == Verdict("failed", ("B.", "C.", "3.0 m."))
    assert found.keys == ("b", "c", "a") and str(found) == "failed: B. C. 3.0 m."


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_levels_follow_the_bounds(value, limit):
    order = [LEVELS.index(above(value, Bound(limit, limit + 1.0)))]
    order.append(LEVELS.index(below(-value, Bound(-limit, -limit - 1.0))))
    expected = 2 if value > limit + 1.0 else 1 if value > limit else 0
    assert order == [expected, expected]


@pytest.mark.parametrize("level", [above, below])
def test_what_is_not_a_number_has_failed(level):
    assert level(float("nan"), Bound(1.0, 1.0)) == FAILED


def test_ranges_of_people_are_ranges():
    assert all(0.0 < least < most for least, most in ADULTS.values())


# 1 and 5 years, 4 standard deviations about the medians of both sexes, by the WHO Child Growth
# Standards: height (m), mass (kg), head girth (m); 12 years by CDC 2000, 97th percentile of mass
CHILDREN = {
    1: (
        0.75,
        {
            "height_m": (0.637, 0.853),
            "mass_kg": (5.5, 15.0),
            "head_circumference_m": (0.394, 0.512),
        },
    ),
    5: (
        1.10,
        {
            "height_m": (0.904, 1.285),
            "mass_kg": (10.4, 33.0),
            "head_circumference_m": (0.442, 0.567),
        },
    ),
    12: (
        1.50,
        {"height_m": (1.21, 1.79), "mass_kg": (28.0, 66.0), "head_circumference_m": (0.49, 0.60)},
    ),
}


def test_limits_of_children_hold_their_extremes_and_no_adult():
    assert PEOPLE.ranges(None, 1.7) is ADULTS and PEOPLE.ranges(18.0, 1.7) is ADULTS
    for years, (stature, extremes) in CHILDREN.items():
        ranges = PEOPLE.ranges(float(years), stature)
        for name, (low, high) in extremes.items():
            assert ranges[name].least * 0.95 < low and high < ranges[name].most * 1.05, (
                years,
                name,
            )
        assert all(
            0.0 < least < most <= ADULTS[name].most for name, (least, most) in ranges.items()
        )
    adult = {"height_m": 1.75, "mass_kg": 75.0}
    (reason,) = measurement_reasons(adult, 5.0, 1.1, PEOPLE)
    assert reason.level == FAILED and "people of that age" in reason.values["people"]
    tall = PEOPLE.ranges(17.0, 1.79)
    assert tall == ADULTS


def test_the_measurement_furthest_outside_is_named_and_the_others_counted():
    body = {"height_m": 1.20, "arm_span_m": 1.0, "waist_circumference_m": 0.8, "other_m": 9.0}
    (reason,) = measurement_reasons(body, None, 1.7, PEOPLE)
    assert reason.level == DOUBTFUL and reason.values["name"] == "arm span"
    assert "1 more measurement " in reason.values["more"]
    assert not list(measurement_reasons(body | {"arm_span_m": 1.2}, 8.0, 1.277, PEOPLE))


def test_words():
    assert words("chest_circumference_m") == "chest circumference"
    assert measured("mass_kg", 70.04) == "70.0 kg" and measured("height_m", 1.755) == "175.5 cm"
    assert percent(0.256) == "26 %" and percent(0.0012, 1) == "0.1 %"
    assert enumerated(("a",)) == "a" and enumerated(["a", "b", "c"]) == "a, b and c"


@given(st.lists(st.tuples(st.sampled_from(LEVELS), st.sampled_from(PARTS))))
def test_parts_count_one_level_milder_than_the_body(reasons):
    found = verdict_of([Reason(level, "b", {}, part) for level, part in reasons], SENTENCES)
    for part in PARTS:
        own = [level for level, other in reasons if other == part]
        assert found.parts[part].level == worst(own)
        assert len(found.parts[part].reasons) == len(own)
    ends = worst([level for level, part in reasons if part != BODY])
    assert found.level == worst([found.parts[BODY].level, DOUBTFUL if ends == FAILED else GOOD])


def test_joints_belong_to_parts():
    names = ("pelvis", "left_knee", "left_ankle", "left_foot", "neck", "head", "jaw")
    names = (*names, "left_elbow", "left_wrist", "left_index1")
    parts = part_of_joint(names, (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8))
    body = ("body", "body", "feet", "feet", "body", "head", "head", "body", "hands", "hands")
    assert parts == body


def test_an_entry_holds_each_part():
    found = verdict_of([Reason(FAILED, "b", {}, HANDS)], SENTENCES).entry()
    assert found["level"] == DOUBTFUL and set(found["parts"]) == set(PARTS)
    assert found["parts"][HANDS] == {"level": FAILED, "reasons": ["B."]}


CLOSE = PeopleLimits(proportions=Bound(5.5, np.inf))


@pytest.mark.parametrize("stretch", [(1.3, 1.0, 1.0), (1.0, 1.0, 0.7), (1.0, 1.35, 1.0)])
def test_a_person_stretched_along_an_axis_has_nobodys_proportions(stretch):
    body = load_body("female")
    rest = body.rest_vertices(body.people_mean)

    def reasons(scale):
        return list(proportion_reasons(body.measure_rest(rest * scale), None, CLOSE))

    assert not reasons(1.0) and not reasons(1.08)
    (reason,) = reasons(stretch)
    assert reason.level == DOUBTFUL and reason.values["distance"] > 5.5
    assert not list(proportion_reasons(body.measure_rest(rest * stretch), 8.0, CLOSE))


def test_a_head_out_of_proportion_speaks_of_the_head_and_a_stretched_person_of_the_body():
    """Hair of 3 cm makes a head of nobody's proportions; what is stretched is so in its feet, too."""
    body = load_body("female")
    rest = body.rest_vertices(body.people_mean)
    limits = replace(CLOSE, head=HEAD)
    measured = dict(body.measure_rest(rest))
    hair = measured | {name: measured[name] + 0.06 for name in ("head_length_m", "head_breadth_m")}
    (reason,) = proportion_reasons(hair, None, limits)
    assert reason.part == HEAD
    (reason,) = proportion_reasons(hair, None, CLOSE)
    assert reason.part == BODY
    narrow = measured | {name: 0.8 * measured[name] for name in ("head_length_m", "head_breadth_m")}
    (reason,) = proportion_reasons(narrow, None, limits)
    assert reason.part == BODY  # no hair makes a head smaller: a scan squeezed in depth was good
    for stretch in ((1.35, 1.0, 1.0), (1.0, 1.0, 0.7), (1.0, 1.35, 1.0)):
        (reason,) = proportion_reasons(body.measure_rest(rest * stretch), None, limits)
        assert reason.part == BODY


@pytest.mark.parametrize("sex", ["female", "male"])
def test_drawn_people_have_peoples_proportions(sex):
    body = load_body(sex)
    people = body.draw_betas(100, np.random.default_rng(0)) + body.people_mean
    rare = [
        list(proportion_reasons(body.measure_rest(body.rest_vertices(one)), None, CLOSE))
        for one in people
    ]
    assert sum(map(bool, rare)) <= 1


def test_proportions_are_those_of_the_survey():
    folder = Path(__file__).resolve().parents[3] / "shared" / "data" / "ansur"
    if not folder.exists():
        pytest.skip("the survey's tables are not here")
    columns = ("stature", "headlength", "headbreadth", "footlength", "footbreadthhorizontal")
    rows = []
    for path in sorted(folder.glob("*.csv")):
        with path.open(encoding="latin1") as file:
            rows += [[float(row[name]) for name in columns] for row in csv.DictReader(file)]
    logs = np.log(np.array(rows) / 1000)
    np.testing.assert_allclose(ADULTS_MEAN, logs.mean(0), atol=1e-4)
    inverse = np.linalg.inv(np.cov(logs.T))
    np.testing.assert_allclose(ADULTS_WHITENING.T @ ADULTS_WHITENING, inverse, atol=2.0)
    assert np.linalg.norm((logs - ADULTS_MEAN) @ ADULTS_WHITENING.T, axis=1).max() < 5.5
