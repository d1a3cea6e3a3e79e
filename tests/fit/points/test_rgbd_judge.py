"""The verdict on a body from depth views: what can be checked decides, and what cannot be is not
called good.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus.fit.points.depth_evidence import Evidence, ViewEvidence, body_evidence, end_names
from habitus.fit.points.depth_result import judge
from habitus.io.models.bodies import load_body

VIEW = ViewEvidence("front", 6.0, 0.5, 20.0, 5.0, 0.99, 0.005, 0.93, 0.0, True, False, 20_000)
SOUND = Evidence((VIEW,), 2.0, 1.0, {"height_m": 1.75}, True, True, "background", 1.74)


def test_a_sound_fit_is_good_and_says_what_is_left():
    verdict = judge(SOUND)
    assert verdict.level == "good" and "one view" in verdict.keys


@pytest.mark.parametrize(
    ("changes", "level", "key"),
    [
        ({"median_mm": 12.0}, "doubtful", "depth"),
        ({"median_mm": 40.0}, "failed", "depth"),
        ({"explained": 0.95}, "doubtful", "unexplained"),
        ({"outside": 0.10}, "failed", "outside"),
        ({"overlap": 0.80}, "doubtful", "overlap"),
    ],
)
def test_a_view_that_does_not_fit_is_named(changes, level, key):
    verdict = judge(replace(SOUND, views=(VIEW, replace(VIEW, name="side", **changes))))
    assert verdict.level == level and key in verdict.keys
    assert "side" in " ".join(verdict.reasons)


@pytest.mark.parametrize(
    ("segmentation", "level"), [("background", "good"), ("mask", "good"), ("planes", "doubtful")]
)
def test_who_did_not_tell_the_room_gets_no_good_verdict(segmentation, level):
    assert judge(replace(SOUND, segmentation=segmentation)).level == level


def test_a_body_lower_than_the_person_and_a_rare_shape_are_doubted():
    assert judge(replace(SOUND, height_seen=1.80)).level == "doubtful"
    assert judge(replace(SOUND, beta_max=7.0)).level == "doubtful"
    assert judge(replace(SOUND, beta_max=9.5)).level == "failed"


def test_a_solve_that_met_numbers_that_are_not_finite_has_failed():
    verdict = judge(replace(SOUND, status="not finite"))
    assert verdict.level == "failed" and "not finite" in verdict.reasons[0]


@pytest.mark.parametrize("years", [5.0, 8.0, 10.0])
def test_a_child_is_held_to_the_limits_of_its_age(years):
    body = load_body("default").at_age(years)
    found = body_evidence(body, np.zeros(body.num_betas), np.zeros(body.num_vertices))
    child = replace(SOUND, height_seen=None, **found)
    assert child.age == years and judge(child).level == "good"
    assert "measurement" in judge(replace(child, age=None)).keys
    assert judge(replace(child, measurements={"height_m": 2.4})).level == "failed"


def test_an_adult_as_small_as_a_child_is_doubted():
    measurements = {"height_m": 1.277, "chest_circumference_m": 0.62}
    assert judge(replace(SOUND, measurements=measurements, height_seen=None)).level == "doubtful"


def test_hair_that_is_measured_with_the_head_is_a_doubt_of_the_head_alone():
    verdict = judge(replace(SOUND, measurements={"height_m": 1.75, "head_circumference_m": 0.74}))
    assert verdict.level == "good" and verdict.parts["head"].level == "doubtful"
    assert "measurement" in verdict.keys


@pytest.mark.parametrize(("share", "hands", "whole"), [(0.02, "good", "good"),
                         (0.10, "doubtful", "good"), (0.30, "failed", "doubtful")])  # fmt: skip
def test_a_hand_off_its_pixels_is_a_matter_of_the_hands(share, hands, whole):
    view = replace(VIEW, ends={"left hand": share, "right foot": 0.0, "head": 0.01})
    verdict = judge(replace(SOUND, views=(view,)))
    assert (verdict.parts["hands"].level, verdict.level) == (hands, whole)
    assert ("left hand" in " ".join(verdict.reasons)) == (hands != "good")


def test_ends_have_names_and_sides():
    body = load_body("default")
    names = end_names(body)
    assert set(names) == {"", "head", "left hand", "right hand", "left foot", "right foot"}
    rest = body.rest_vertices(np.zeros(body.num_betas))
    assert rest[names == "left hand", 0].min() > rest[names == "", 0].max() / 2
    assert rest[names == "right foot", 1].max() < 0.3 * np.ptp(rest[:, 1]) + rest[:, 1].min()
