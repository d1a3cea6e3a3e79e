"""Views without usable pixels: people cut out of their background, views in which the body is drawn
nowhere, empty masks.
"""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_scene_small import small_scene

from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.points.depth import fit_views
from habitus.fit.points.depth_energy import DepthEnergy, SkinnedState
from habitus.fit.points.depth_settings import SEGMENTATION, RgbdSettings
from habitus.fit.points.prepared_views import PreparedView, segment
from habitus.fit.points.skin_offsets import SkinField


def cut_out(view, keep=1.0):
    """A view of the person alone: a mask, no floor, no empty room, no colour; of the mask's rows
    the upper share ``keep``.
    """
    mask = segment(view).mask
    rows = np.flatnonzero(mask.any(1))
    mask[rows[0] + int(keep * len(rows)) :] = False
    depth = np.where(mask, view.depth, 0.0)
    return replace(view.without("background", "colour"), depth=depth, mask=mask)


def test_people_cut_out_of_their_background_are_fitted_and_a_view_without_them_is_named():
    body, scene = small_scene()
    one, other = (cut_out(view) for view in scene.capture.views)
    nobody = replace(other, mask=np.zeros_like(other.mask), name="nobody here")
    fit = fit_views(replace(scene.capture, views=(one, nobody)), body)
    assert len(fit.pose) == 1 and fit.evidence.segmentation == "mask"
    assert any("nobody here" in note and "0 pixels" in note for note in fit.warnings)
    assert not any("walls" in note for note in fit.warnings)
    (seen,) = fit.evidence.views  # outlines of such small images overlap by 71 to 77 %
    assert seen.median_mm < 4.0 and seen.explained > 0.95 and seen.overlap > 0.65


def test_no_person_in_any_view_is_refused_in_one_line():
    body, scene = small_scene()
    views = [
        replace(cut_out(view), mask=np.zeros_like(view.depth, bool)) for view in scene.capture.views
    ]
    with pytest.raises(HabitusError, match="2 views") as error:
        fit_views(replace(scene.capture, views=tuple(views)), body)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("lost", [[0], [0, 1]])
def test_a_body_that_is_drawn_in_no_pixel_of_a_view_is_legal(lost):
    """It has neither depth nor outline there, with skin offsets and without."""
    body, scene = small_scene()
    prepared_views = [PreparedView.of(view, segment(view)) for view in scene.capture.views]
    energy = DepthEnergy.of(body, prepared_views, RgbdSettings())
    pose = np.zeros((2, body.num_joints, 3))
    trans = np.tile([0.0, 1.0, 0.0], (2, 1))
    trans[lost, 2] = 50.0
    state = BodyState(np.zeros(body.num_betas), pose, trans)
    field = SkinField.of(body, energy.settings)
    skinned = SkinnedState(state.betas, pose, trans, np.zeros(field.count))
    for found in (
        energy.minimized(state, pose, energy.settings.stages[:1]),
        energy.with_skin(skinned, pose, field),
    ):
        assert found.status in ("converged", "iterations", "stalled")
        assert np.isfinite(found.cost)


def test_a_grid_of_few_pixels_is_finer():
    _, scene = small_scene()
    view = cut_out(scene.capture.views[0], keep=0.3)
    sight = PreparedView.of(view, segment(view))
    assert sight.grid(2).stride == 2
    coarse = sight.grid(40)
    assert coarse.stride < 40 and coarse.person.sum() >= SEGMENTATION.grid_pixels
