"""Depth views of calibrated cameras."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from habitus.observe.camera import Camera, DepthView  # noqa: E402


def test_a_calibrated_view_in_its_own_frame_shows_the_same_pixels():
    rng = np.random.default_rng(0)
    rotation, shift, colour_rotation, colour_shift = rng.normal(size=(4, 3))
    camera = Camera.of(40, 30, 35.0, rotation=rotation, translation=shift)
    colour = Camera.of(40, 30, 33.0, rotation=colour_rotation, translation=colour_shift)
    image = np.zeros((30, 40, 3), np.uint8)
    view = DepthView(np.ones((30, 40)), camera, image, colour).in_camera_frame()
    assert not view.camera.rotation.any() and not view.camera.translation.any()
    seen = torch.from_numpy(rng.normal(size=(9, 3)) + np.array([0.0, 0.0, 4.0]))
    world = camera.to_world(seen)
    torch.testing.assert_close(view.camera.project(seen), camera.project(world))
    torch.testing.assert_close(
        view.colour_camera.to_camera(seen), colour.to_camera(world), atol=1e-9, rtol=1e-9
    )
    assert view.in_camera_frame() is view
