"""Laws of what people's markers tell of a place: means move with agreement, few people move them
little.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus.fit.placements import Seen, learned, offsets_at_rest
from habitus.io.layouts.files import plain_layout
from habitus.io.models.bodies import load_body
from habitus.markers.layouts import Marker
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers

OFF = np.array([0.004, 0.024, 0.006])
PLACES = ("knee_lateral", "heel", "asis", "ankle_lateral", "elbow_lateral")


@pytest.fixture(scope="module")
def body():
    return load_body("default")


def people(count, own, rng, shared=OFF, place="knee_lateral", label="[LR]KNE"):
    """Left and right markers of people whose placements have a mean, and a spread (m) that both
    sides share.
    """
    found = []
    for k in range(count):
        mine = shared + rng.normal(scale=own, size=3)
        for side in ("left", "right"):
            offset = mine + rng.normal(scale=0.002, size=3)
            marker = Marker(label.replace("[LR]", side[0].upper()), landmark=f"{side}_{place}")
            found.append(Seen(f"{k}", place, label, marker, tuple(offset)))
    return found


def elsewhere(rng, count=5):
    """The same people at other places, each with a mean of its own."""
    return [
        one
        for place in PLACES[1:]
        for one in people(count, 0.008, rng, rng.normal(scale=0.012, size=3), place, f"[LR]{place}")
    ]


def height_of(prior, place="knee_lateral"):
    return prior.places[place].shift[1]


def test_many_people_who_agree_are_believed_and_one_only_in_part(body):
    rng = np.random.default_rng(0)
    many = learned(people(8, 0.004, rng) + elsewhere(rng), body)
    one = learned(people(1, 0.004, np.random.default_rng(0)) + elsewhere(rng), body)
    assert height_of(many) == pytest.approx(OFF[1], abs=0.006)
    assert 0.0 < height_of(one) < 0.8 * OFF[1]
    assert many.places["knee_lateral"].people == 8 and one.places["knee_lateral"].people == 1
    assert many.places["knee_lateral"].spread < one.places["knee_lateral"].spread


def test_a_stray_person_moves_nobody(body):
    rng = np.random.default_rng(1)
    rest = people(8, 0.006, rng, np.zeros(3)) + elsewhere(rng)
    stray = [Seen("stray", "knee_lateral", "[LR]KNE", rest[0].marker, (0.0, -0.12, 0.0))]
    assert abs(height_of(learned(rest + stray, body)) - height_of(learned(rest, body))) < 0.006


def test_the_share_that_twins_tell_is_found(body):
    rng = np.random.default_rng(3)
    twins = [replace(one, twin=one.offset) for one in people(12, 0.01, rng, np.zeros(3))]
    halves = [replace(one, offset=tuple(0.5 * np.array(one.twin))) for one in twins]
    assert learned(halves, body).alike == pytest.approx((0.5, 0.0), abs=0.1)


def test_a_planted_offset_is_carried_back_to_rest(body):
    layout = plain_layout("cmu-41").restricted_to(("LKNE", "RELB", "C7", "LFHD"))
    rng = np.random.default_rng(2)
    betas = rng.normal(scale=0.5, size=body.num_betas)
    offsets = rng.normal(scale=0.01, size=(4, 3))
    start = default_markers(body, betas, layout.vertices(body), layout.distances())
    rest = body.rest_vertices(betas)
    own = attach(start, rest, body.faces).triangles
    pose = rng.normal(scale=0.3, size=(5, body.num_joints, 3))
    trans = rng.normal(size=(5, 3))
    observed = predict(
        marked_body(body, betas, attach(start + offsets, rest, body.faces, triangles=own)),
        pose,
        trans,
    )
    observed[1, 2], observed[1:, 3] = np.nan, np.nan
    found = offsets_at_rest(body, betas, pose, trans, layout, observed)
    np.testing.assert_allclose(found[:3], offsets[:3], atol=1e-9)
    assert np.isnan(found[3]).all()
