"""Verdicts: the worst level decides, limits of people depend on age, sentences are filled in."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from habitus.fit.verdict import (
    ADULTS,
    BODY,
    DOUBTFUL,
    FAILED,
    GOOD,
    HANDS,
    LEVELS,
    PARTS,
    PEOPLE,
    Bound,
    Reason,
    Verdict,
    above,
    below,
    enumerated,
    measured,
    measurement_reasons,
    part_of_joint,
    percent,
    verdict_of,
    weigh,
    words,
    worst,
)

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
