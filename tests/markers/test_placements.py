"""Laws of the prior over placements: sides mirror, labels go before places, and what nobody knows
stays.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus.io.layouts.files import list_layouts, load_layout, load_placements, plain_layout
from habitus.markers.checks import other_side
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.placements import PlacementPrior, UsualPlace, label_keys, sideless

HERE = UsualPlace((0.01, -0.02, 0.03), 0.004)
THERE = UsualPlace((0.0, 0.05, 0.0), -0.001, 0.012, 2)
PRIOR = PlacementPrior({"asis": HERE}, {("asis", "[LR]FWT"): THERE})
PAIR = (Marker("LFWT", landmark="left_asis"), Marker("RFWT", landmark="right_asis"))
OTHERS = (
    Marker("LASI", landmark="left_asis"),
    Marker("RASI", landmark="right_asis"),
    Marker("C7", landmark="c7"),
)


def test_a_label_goes_before_its_place_and_others_stay():
    moved = PRIOR.applied(MarkerLayout("x", (*PAIR, *OTHERS)))
    assert moved["LFWT"].shift == THERE.shift and moved["LFWT"].place_spread == PAIR[0].place_spread
    assert moved["LASI"].shift == HERE.shift
    assert moved["LASI"].distance == pytest.approx(
        OTHERS[0].distance + 0.001
    )  # as far as the layout is unsure
    unsure = PRIOR.applied(MarkerLayout("x", (replace(OTHERS[0], distance_spread=0.02),)))
    assert unsure["LASI"].distance == pytest.approx(OTHERS[0].distance + HERE.off)
    assert moved["C7"] == OTHERS[2]


def test_sides_mirror():
    layout = MarkerLayout("x", (*PAIR, *OTHERS))
    mirrored = replace(layout, markers=tuple(other_side(marker) for marker in layout.markers))
    assert PRIOR.applied(mirrored).markers == tuple(
        other_side(marker) for marker in PRIOR.applied(layout).markers
    )


def test_a_shift_of_the_layout_itself_stays():
    own = replace(PAIR[0], shift=(0.0, 0.0, 0.01))
    assert PRIOR.applied(MarkerLayout("x", (own,)))["LFWT"] == own


def test_twins_are_told_by_their_places():
    names = ("LFWT", "RFWT", "L.Knee", "R.Knee", "LBAK", "CLAV", "l_calc", "r_calc")
    places = ("asis", "asis", "knee_lateral", "knee_lateral", "scapula_mid", "c7", "heel", "heel")
    markers = [
        Marker(
            name,
            landmark=place
            if name == "CLAV"
            else f"{'left' if name[0] in 'Ll' else 'right'}_{place}",
        )
        for name, place in zip(names, places, strict=True)
    ]
    keys = label_keys(MarkerLayout("x", tuple(markers)))
    assert (
        list(keys.values())
        == ["[LR]FWT"] * 2 + ["[LR].Knee"] * 2 + ["LBAK", "CLAV"] + ["[lr]_calc"] * 2
    )


def test_no_marker_sinks_into_the_skin():
    deep = PlacementPrior({"asis": UsualPlace((0.0, 0.0, 0.0), -0.05)})
    wand = replace(PAIR[0], distance_spread=0.03)
    assert deep.applied(MarkerLayout("x", (wand,)))["LFWT"].distance == 0.005


@pytest.mark.parametrize("name", list_layouts())
def test_the_shipped_prior_moves_shipped_layouts_and_their_places_only(name):
    plain = plain_layout(name)
    loaded = load_layout(name)
    known = load_placements().places
    for before, after in zip(plain.markers, loaded.markers, strict=True):
        assert after.place == before.place and after.aliases == before.aliases
        assert (after.shift is not None) == (sideless(before.place) in known)
        assert after.shift is None or np.linalg.norm(after.shift) < 0.1
        assert 0.0 <= after.distance < 0.1


TWINS = PlacementPrior(alike=(0.8, 0.3))
UP = np.array([[0.004, 0.02, 0.01]])


def test_a_twin_is_expected_where_its_mirror_image_was_found():
    left, right = (MarkerLayout("x", (marker,)) for marker in PAIR)
    np.testing.assert_allclose(TWINS.expected(left, UP, right), 0.8 * UP * [-1, 1, 1])
    np.testing.assert_allclose(TWINS.expected(right, UP, left), 0.8 * UP * [-1, 1, 1])


def test_what_is_placed_freely_has_a_share_of_its_own():
    free = MarkerLayout("x", (replace(PAIR[1], place_spread=0.04),))
    np.testing.assert_allclose(
        TWINS.expected(MarkerLayout("x", PAIR[:1]), UP, free), 0.3 * UP * [-1, 1, 1]
    )


def test_other_labels_and_places_tell_nothing():
    assert not TWINS.expected(
        MarkerLayout("x", PAIR), np.tile(UP, (2, 1)), MarkerLayout("x", OTHERS)
    ).any()


def test_a_twin_that_is_elsewhere_tells_nothing():
    far = np.array([[0.0, 0.15, 0.0]])
    assert not TWINS.expected(MarkerLayout("x", PAIR[:1]), far, MarkerLayout("x", PAIR[1:])).any()


def test_nothing_known_or_nothing_alike_expects_nothing():
    whole = MarkerLayout("x", PAIR)
    assert not TWINS.expected(MarkerLayout("none", ()), np.zeros((0, 3)), whole).any()
    assert not PRIOR.expected(MarkerLayout("x", PAIR[:1]), UP, MarkerLayout("x", PAIR[1:])).any()
