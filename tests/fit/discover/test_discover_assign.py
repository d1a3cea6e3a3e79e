"""Soft assignment: distances and posteriors against their definitions, and turned bodies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted import person

from habitus.fit.discover.settings import DISCOVER
from habitus.fit.discover.skin import betas_of_height, spread_places, wearable
from habitus.fit.discover.starts import (
    Bodies,
    _directions,
    posteriors,
    squared_distances,
    turned,
)
from habitus.rotations import matrix_from_rotvec


@given(st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_squared_distances_are_means_over_the_frames_in_which_a_label_is_seen(seed):
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(2, 3, 5, 3))
    observed = rng.normal(size=(3, 4, 3))
    observed[rng.random((3, 4)) < 0.3] = np.nan
    observed[0] = rng.normal(size=(4, 3))
    by_hand = np.nanmean(
        np.sum((observed[None, :, :, None] - places[:, :, None]) ** 2, axis=4), axis=1
    )
    np.testing.assert_allclose(squared_distances(places, observed), by_hand, atol=1e-9)


@given(st.floats(0.1, 0.5), st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_posteriors_prefer_what_is_near_and_leave_a_share_for_nowhere(sigma, seed):
    squared = np.random.default_rng(seed).random((2, 4, 6))
    posterior, energy = posteriors(squared, sigma)
    assert (posterior >= 0).all() and (posterior.sum(axis=2) <= 1 + 1e-12).all()
    np.testing.assert_array_equal(np.argmax(posterior, axis=2), np.argmin(squared, axis=2))
    assert (energy <= (DISCOVER.outlier * sigma) ** 2 + 1e-9).all()


def test_turned_twice_is_as_before():
    body = person()
    rng = np.random.default_rng(0)
    skin = spread_places(body, 60)
    pose = 0.5 * rng.normal(size=(2, 3, body.num_joints, 3))
    trans = rng.normal(size=(2, 3, 3))
    bodies = Bodies(pose, trans, np.zeros(2), rng.random((2, 5, 60)))
    once = turned(body, bodies, skin)
    twice = turned(body, once, skin)
    np.testing.assert_allclose(matrix_from_rotvec(twice.pose), matrix_from_rotvec(pose), atol=1e-9)
    ahead, now = (matrix_from_rotvec(each.pose[:, :, 0])[..., 2] for each in (bodies, once))
    np.testing.assert_allclose(now, -ahead, atol=1e-9)


def test_directions_are_48_different_rotations():
    matrices = matrix_from_rotvec(_directions())
    apart = np.abs(matrices[:, None] - matrices[None]).max(axis=(2, 3)) + np.eye(len(matrices))
    assert len(matrices) == 48 and apart.min() > 0.1


@pytest.mark.parametrize("height", [1.5, 1.9])
def test_a_body_of_a_height_has_it(height):
    body = person()
    assert np.ptp(body.rest_vertices(betas_of_height(body, height))[:, 1]) == pytest.approx(
        height, abs=0.01
    )


def test_places_are_spread_over_the_skin_and_not_on_fingertips_and_soles():
    body = person()
    skin = spread_places(body, 150)
    free = wearable(body)
    assert free[skin.vertices].all() and len(set(skin.vertices.tolist())) == 150
    assert not any(free[body.landmarks[name]] for name in ("left_index_tip", "right_pinky_dip"))
    assert all(
        free[body.landmarks[name]]
        for name in ("left_hand_back", "right_index_mcp", "c7", "left_heel")
    )
    np.testing.assert_allclose(skin.points[skin.across][:, 0], -skin.points[:, 0], atol=0.08)
