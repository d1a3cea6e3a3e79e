"""Pairs of markers whose labels change places: told by anatomy, by time, and only where the
evidence is strong.
"""

import numpy as np
import pytest

from habitus.markers.geometry import (
    PAIRS,
    Exchange,
    Scene,
    exchange_columns,
    leg_outward,
    pair_order,
)

FRAMES = 60
OUT = np.array([1.0, 0.0, 0.0])


def pair(frames=FRAMES, seed=0):
    """Two markers 6 cm apart that turn slowly, and the direction in which the first lies, unsure by
    some 20 degrees.
    """
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0, frames)
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(frames)], axis=1)
    middle = np.cumsum(0.01 * rng.normal(size=(frames, 3)), axis=0)
    hint = direction + 0.3 * rng.normal(size=(frames, 3))
    return (
        middle + 0.03 * direction,
        middle - 0.03 * direction,
        hint / np.linalg.norm(hint, axis=1, keepdims=True),
    )


def swapped_in(first, second, frames):
    markers = np.stack([first, second], axis=1)
    exchange_columns(markers, Exchange(0, 1, frames))
    return markers[:, 0], markers[:, 1]


def test_a_pair_in_order_is_left_alone():
    first, second, hint = pair()
    order = pair_order(first, second, [hint])
    assert not order.swapped and not order.odd_frames.any()


def test_a_pair_exchanged_throughout_is_found_by_anatomy():
    first, second, hint = pair()
    order = pair_order(second, first, [hint])
    assert order.swapped and not order.odd_frames.any()


@pytest.mark.parametrize("begin, end", [(0, 12), (20, 35), (50, 60)])
@pytest.mark.parametrize("hinted", [True, False])
def test_a_pair_exchanged_for_a_while_is_found_by_time(begin, end, hinted):
    first, second, hint = pair()
    frames = np.zeros(FRAMES, dtype=bool)
    frames[begin:end] = True
    order = pair_order(*swapped_in(first, second, frames), [hint] if hinted else [])
    assert not order.swapped
    np.testing.assert_array_equal(order.odd_frames, frames)


def test_exchanged_most_of_the_time_is_odd_in_those_frames():
    first, second, hint = pair()
    frames = np.ones(FRAMES, dtype=bool)
    frames[15:25] = False
    order = pair_order(*swapped_in(first, second, frames), [hint])
    assert not order.swapped
    np.testing.assert_array_equal(order.odd_frames, frames)


def test_directions_that_disagree_or_are_few_say_nothing():
    first, second, hint = pair()
    torn = np.where(np.arange(FRAMES)[:, None] % 2 == 0, hint, -hint)
    few = np.where(np.arange(FRAMES)[:, None] < 5, hint, np.nan)
    across = np.cross(hint, (0.0, 0.0, 1.0))
    for expected in ([torn], [few], [across], []):
        order = pair_order(second, first, expected)
        assert not order.swapped and not order.odd_frames.any()


def test_several_directions_are_averaged_and_gaps_of_one_are_filled_by_another():
    first, second, hint = pair()
    half = np.where(np.arange(FRAMES)[:, None] < 30, hint, np.nan)
    assert pair_order(second, first, [half, np.where(np.isnan(half), hint, np.nan)]).swapped
    assert not pair_order(second, first, [0.1 * hint, -0.9 * hint]).swapped


def test_what_gaps_separate_is_judged_run_by_run():
    first, second, hint = pair()
    frames = np.arange(FRAMES) >= 32
    one, two = swapped_in(first, second, frames)
    one[28:32] = two[28:32] = np.nan
    order = pair_order(one, two, [hint])
    np.testing.assert_array_equal(order.odd_frames, frames)
    assert not order.swapped


def test_a_pair_that_turned_much_in_a_single_missing_frame_is_judged_anew():
    first, second, hint = pair()
    turned = np.arange(FRAMES) >= 30
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    middle = (first + second) / 2
    half = (first - second) / 2
    half, hint = (np.where(turned[:, None], each @ quarter.T, each) for each in (half, hint))
    one, two = swapped_in(middle + half, middle - half, turned)
    one[30] = two[30] = np.nan
    order = pair_order(one, two, [hint])
    assert not order.swapped
    np.testing.assert_array_equal(order.odd_frames, np.arange(FRAMES) > 30)


@pytest.mark.parametrize("medial", [True, False])
def test_knees_follow_their_ankles_or_where_one_of_these_lacks_the_pelvis(medial):
    places = {
        "right_asis": (-0.1, 1.0, 0.0),
        "left_asis": (0.1, 1.0, 0.0),
        "left_ankle_lateral": (0.1, 0.1, 0.1),
    }
    places |= {"left_ankle_medial": (0.05, 0.1, 0.0)} if medial else {}
    scene = Scene(np.array([list(places.values())]), {name: k for k, name in enumerate(places)})
    expected = {first: expect for first, _, expect in PAIRS}["knee_lateral"](scene, "left")[1]
    np.testing.assert_allclose(
        expected, [[0.2**0.5, 0.0, 0.8**0.5]] if medial else leg_outward(scene, "left")
    )


def test_markers_go_back_to_their_columns_and_the_others_stay():
    markers = np.random.default_rng(0).normal(size=(6, 4, 3))
    frames = np.array([0, 1, 1, 0, 0, 1], dtype=bool)
    changed = markers.copy()
    exchange_columns(changed, Exchange(1, 3, frames))
    np.testing.assert_array_equal(changed[frames][:, [0, 3, 2, 1]], markers[frames])
    np.testing.assert_array_equal(changed[~frames], markers[~frames])
