"""The floor of a made room, the person before it, and what is left when nobody is there."""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_scene_small import small_scene

from habitus.errors import HabitusError
from habitus.fit.points.prepared_views import (
    Floor,
    find_floor,
    level_frame,
    seen_through,
    segment,
)
from habitus_lab.population.rgbd_people import _TILT, CAMERA_HEIGHT


def test_the_floor_is_where_it_was_made():
    _, scene = small_scene()
    found = segment(scene.capture.views[0]).floor
    up = np.array([0.0, -np.cos(_TILT), -np.sin(_TILT)])
    assert np.rad2deg(np.arccos(found.normal @ up)) < 1.5
    assert abs(found.height + CAMERA_HEIGHT) < 0.04


def test_the_world_of_a_floor_stands_upright():
    floor = Floor(np.array([0.1, -0.98, -0.15]) / np.linalg.norm([0.1, -0.98, -0.15]), -1.2)
    turn, shift = floor.world
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) > 0
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3))
    np.testing.assert_allclose((points @ turn.T + shift)[:, 1], floor.above(points), atol=1e-12)
    np.testing.assert_allclose(
        level_frame(np.array([0.0, -1.0, 0.0])), np.diag([1.0, -1.0, -1.0]), atol=1e-12
    )


def test_no_floor_among_walls():
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(-1, 1, (2, 40, 40)), np.full((40, 40), 3.0)], -1)
    assert find_floor(points, np.ones((40, 40), bool)) is None


@pytest.mark.parametrize("without", [(), ("background",)], ids=["empty room", "planes"])
def test_the_person_is_found(without):
    _, scene = small_scene()
    view = scene.capture.views[0]
    truth = (view.background > 0) & (view.depth > 0) & (view.background - view.depth > 0.15)
    found = segment(view.without(*without)).mask
    assert (found & truth).sum() / (found | truth).sum() > (0.7 if not without else 0.6)


def test_a_mask_is_taken_as_it_is():
    _, scene = small_scene()
    view = scene.capture.views[0]
    half = segment(view).mask.copy()
    half[:, : half.shape[1] // 2] = False
    found = segment(replace(view, mask=half))
    assert (
        found.segmentation == "mask"
        and not (found.mask & ~half).any()
        and found.mask.sum() > 0.9 * half.sum()
    )


def test_nobody_is_told():
    _, scene = small_scene()
    view = scene.capture.views[0]
    with pytest.raises(HabitusError, match="pixels of a person"):
        segment(replace(view, depth=view.background))


@pytest.mark.parametrize("step", (0.0, 0.02))
def test_coarse_steps_of_depth_are_noise_too(step):
    """A still room has the same steps twice; their size is told by the depths that never occur."""
    _, scene = small_scene()
    view = scene.capture.views[0]
    shot, empty = (np.where(d > 0, _rounded(d, step), 0.0) for d in (view.depth, view.background))
    noise = segment(replace(view, depth=shot, background=empty)).noise
    far = np.median(shot[shot > 0])
    assert (noise * far**2 > 0.8 * step / np.sqrt(12)) and (noise < 5e-3 or step)


def _rounded(depth, step):
    return np.round(depth / step) * step if step else depth


@pytest.mark.parametrize("without", [(), ("background",)], ids=["empty room", "planes"])
def test_mixed_depths_are_not_the_room_s(without):
    """A thin hand before a wall has depths between both: nothing was seen through it."""
    _, scene = small_scene()
    view = scene.capture.views[0].without(*without)
    hand = np.zeros(view.depth.shape, bool)
    hand[8:20, 5:8] = True
    mixed = view.depth.copy()
    mixed[hand] *= np.random.default_rng(0).uniform(0.55, 0.95, hand.sum())
    view = replace(view, depth=mixed)
    found = segment(view)
    behind = seen_through(view, found)
    assert (view.depth[hand] > 0).mean() > 0.9 and not found.mask[hand].any()
    assert (behind[hand] > 0).mean() < 0.05
    around = ~found.mask & ~hand & (view.depth > 0)
    assert (behind[around] > 0).mean() > 0.8
