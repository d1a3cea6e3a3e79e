"""The verdict on a body from depth views: what can be checked decides, and what cannot be is not
called good.
"""

from dataclasses import replace

import pytest

from habitus.fit.rgbd.evidence import Evidence, ViewEvidence
from habitus.fit.rgbd.judge import judge

VIEW = ViewEvidence("front", 6.0, 0.5, 20.0, 5.0, 0.99, 0.005, 0.93, 0.0, True, False, 20_000)
SOUND = Evidence((VIEW,), 2.0, 1.0, {"height_m": 1.75}, True, True, "background", 1.74)


def test_a_sound_fit_is_good_and_says_what_is_left():
    verdict = judge(SOUND)
    assert verdict.level == "good" and any("One view only" in reason for reason in verdict.reasons)


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({"median_mm": 12.0}, "doubtful", "Half of the depth pixels"),
        ({"median_mm": 40.0}, "failed", "Half of the depth pixels"),
        ({"explained": 0.95}, "doubtful", "more than 5 cm from the body"),
        ({"outside": 0.10}, "failed", "where the room behind was seen"),
        ({"overlap": 0.80}, "doubtful", "overlap by 80 %"),
    ],
)
def test_a_view_that_does_not_fit_is_named(changes, level, words):
    verdict = judge(replace(SOUND, views=(VIEW, replace(VIEW, name="side", **changes))))
    assert verdict.level == level and any(words in reason for reason in verdict.reasons)


@pytest.mark.parametrize(
    ("way", "level"), [("background", "good"), ("mask", "good"), ("planes", "doubtful")]
)
def test_who_did_not_tell_the_room_gets_no_good_verdict(way, level):
    assert judge(replace(SOUND, way=way)).level == level


def test_a_body_lower_than_the_person_and_a_rare_shape_are_doubted():
    assert judge(replace(SOUND, height_seen=1.80)).level == "doubtful"
    assert judge(replace(SOUND, beta_max=5.5)).level == "doubtful"
    assert judge(replace(SOUND, beta_max=7.0)).level == "failed"
