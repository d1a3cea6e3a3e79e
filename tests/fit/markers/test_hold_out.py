"""Held-out markers: their error is the distance from the layout's place on the fitted body, and
nothing saw them.
"""

from dataclasses import replace

import numpy as np
import pytest
from planted import attach, carried, fit, person, place_by_hand, plant, rest, settings

from habitus.fit.markers.hold_out import held_out_errors, merged
from habitus.fit.markers.solution import HeldOut

HELD = ("RKNE", "STRN", "LELB")


@pytest.fixture(scope="module")
def planted():
    return plant(frames=24)


def without(planted, labels):
    kept = tuple(marker for marker in planted.layout.markers if marker.label not in labels)
    columns = planted.columns(*(marker.label for marker in kept))
    return replace(
        planted, layout=replace(planted.layout, markers=kept), observed=planted.observed[:, columns]
    )


def only(planted, labels):
    return replace(planted.layout, markers=tuple(planted.layout[label] for label in labels))


@pytest.fixture(scope="module")
def fitted(planted):
    return fit(without(planted, HELD), which=settings(annealing=(10.0, 1.0)))


@pytest.fixture(scope="module")
def ideal(planted, fitted):
    """Held-out markers at the layout's places on the fitted body: with soft tissue, and in the pose
    stage.
    """
    layout = only(planted, HELD)
    latent = place_by_hand(fitted.betas, layout)
    attachment = attach(latent, rest(fitted.betas), np.asarray(person().faces))
    soft = carried(attachment, fitted.betas + fitted.soft_tissue, fitted.pose, fitted.trans)
    return layout, soft, carried(attachment, fitted.betas, *fitted.pose_stage)


def test_the_error_is_the_offset_made_by_hand(fitted, ideal):
    layout, soft, posed = ideal
    offsets = np.array([[0.03, 0.0, 0.0], [0.0, -0.04, 0.03], [0.01, 0.02, 0.02]])
    lengths = np.tile([0.03, 0.05, 0.03], (24, 1))
    errors = held_out_errors(fitted, layout, soft + offsets)
    assert errors.labels == HELD
    np.testing.assert_allclose(errors.soft_tissue, lengths, atol=1e-9)
    np.testing.assert_allclose(
        held_out_errors(fitted, layout, posed + offsets).pose, lengths, atol=1e-9
    )


def test_one_frame_and_one_marker_answer_for_themselves(fitted, ideal):
    layout, soft, _ = ideal
    moved = soft.copy()
    moved[7, 1] += (0.0, 0.1, 0.0)
    moved[9, 2] = np.nan
    expected = np.zeros((24, 3))
    expected[7, 1], expected[9, 2] = 0.1, np.nan
    np.testing.assert_allclose(
        held_out_errors(fitted, layout, moved).soft_tissue, expected, atol=1e-9
    )


def test_without_soft_tissue_there_is_one_error(fitted, ideal):
    layout, _, posed = ideal
    errors = held_out_errors(replace(fitted, soft_tissue=None), layout, posed)
    assert errors.soft_tissue is None
    np.testing.assert_allclose(errors.pose, 0.0, atol=1e-9)


def test_markers_where_the_layout_says_are_predicted(planted, fitted):
    """Planted without a placement error: what is left is what the fit of the others leaves open
    there.
    """
    errors = held_out_errors(
        fitted, only(planted, HELD), planted.observed[:, planted.columns(*HELD)]
    )
    assert errors.soft_tissue.mean() < 0.02
    with_them = fit(planted, which=settings(annealing=(10.0, 1.0)))
    assert errors.soft_tissue.mean() > np.nanmean(with_them.errors()[:, planted.columns(*HELD)])


def test_folds_stand_side_by_side():
    one = HeldOut(("A", "B"), np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]]))
    two = HeldOut(("C",), np.array([[5.0]]), np.array([[6.0]]))
    both = merged([one, two])
    assert both.labels == ("A", "B", "C")
    np.testing.assert_array_equal(both.pose, [[1.0, 2.0, 5.0]])
    np.testing.assert_array_equal(both.soft_tissue, [[3.0, 4.0, 6.0]])
    assert merged([one, replace(two, soft_tissue=None)]).soft_tissue is None
