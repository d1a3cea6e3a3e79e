"""Soft tissue along directions of shape, dynamic blend shapes, or both: markers, by the kernels and
by the body.
"""

from dataclasses import replace

import numpy as np
import pytest
from rigged_body import random_body
from soft_tubes import planted_regressor

from habitus.body.dynamics import Dynamics
from habitus.body.soft_tissue import SPACES, check_space, parted, soft_count
from habitus.errors import HabitusError
from habitus.observe.marker_prediction import BodyMarkers, marked_body, predict
from habitus.observe.marker_rig import MarkerRig, marker_rig
from habitus.observe.markers import attach, predict_markers


def _setting(**changes):
    body = random_body(3)
    rng = np.random.default_rng(4)
    body = replace(
        body, dynamics=Dynamics(0.05 * rng.normal(size=(40, 3, 2)), planted_regressor()), **changes
    )
    betas = rng.normal(size=5)
    rest = body.rest_vertices(betas)
    latent = rest[body.faces[:12, 0]] + 0.05 * rng.normal(size=(12, 3))
    attachment = attach(latent, rest, body.faces, triangles=body.faces[:12])
    pose = 0.4 * rng.normal(size=(3, 6, 3))
    trans = rng.normal(size=(3, 3))
    return body, betas, attachment, pose, trans, rng


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
@pytest.mark.parametrize("space", SPACES)
def test_markers_ride_on_the_body_that_moves(space, skinning):
    body, betas, attachment, pose, trans, rng = _setting(skinning=skinning)
    soft = rng.normal(size=(3, soft_count(body, space)))
    change, moving = parted(body, space, soft)
    expected = predict_markers(
        body(betas + change, pose, trans, dynamics=moving).vertices, attachment
    )
    dense = BodyMarkers(body, betas, attachment, space)
    marked = marked_body(body, betas, attachment, space)
    assert isinstance(marked, MarkerRig) == (skinning == "lbs")
    assert dense.num_betas == marked.num_betas == soft.shape[1]
    for found in (dense, marked):
        np.testing.assert_allclose(predict(found, pose, trans, soft), expected, atol=1e-12)
    found = dense.jacobian(pose, trans, soft)
    np.testing.assert_allclose(found.markers, expected, atol=1e-12)
    for k in range(soft.shape[1]):
        step = 1e-6 * np.eye(soft.shape[1])[k]
        slope = (
            dense.predict(pose, trans, soft + step) - dense.predict(pose, trans, soft - step)
        ) / 2e-6
        np.testing.assert_allclose(found.by_betas[..., k], slope, atol=1e-8)


def test_directions_of_shape_are_the_same_arrays_as_ever():
    body, betas, attachment, *_ = _setting()
    for found, known in zip(
        marked_body(body, betas, attachment), marker_rig(body, betas, attachment), strict=True
    ):
        np.testing.assert_array_equal(found, known)


def test_spaces_that_a_body_has_not():
    with pytest.raises(
        HabitusError, match="soft tissue is 'jelly'; expected one of shape, dynamics, both"
    ):
        check_space(random_body(), "jelly")
    check_space(random_body(), "shape")
    for space in ("dynamics", "both"):
        with pytest.raises(HabitusError, match="random has no dynamic blend shapes"):
            check_space(random_body(), space)
