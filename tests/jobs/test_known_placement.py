"""Held-out markers at the places that another capture has: near where they really sit, and still
without a say.
"""

import numpy as np
import pytest
from planted import person, plant

from habitus.errors import HabitusError
from habitus.io.captures.read import Capture
from habitus.jobs.mosh import mosh

HELD = ("STRN", "LELB", "LTHI", "RKNE")


def capture(planted, frames, name, without=(), moved=()):
    observed = np.array(planted.observed[frames])
    observed[:, planted.columns(*moved)] += (0.0, 0.04, 0.0)
    kept = [k for k, label in enumerate(planted.layout.labels) if label not in without]
    return Capture(
        name, tuple(planted.layout.labels[k] for k in kept), observed[:, kept], 30.0, "+y"
    )


@pytest.fixture(scope="module")
def planted():
    return plant(frames=24)


def run(one, other, **options):
    return mosh(
        one, layout="cmu-41", body=person(), soft_tissue="none", placements_from=other, **options
    )[0]


@pytest.fixture(scope="module")
def held_and_fit(planted):
    held = tuple(label for label in planted.layout.labels if label in HELD)
    one = capture(planted, slice(0, 8), "walk")
    other = capture(planted, slice(8, 24), "other")
    return held, run(one, other, hold_out=held)


def test_places_of_another_capture_are_nearer_than_the_layouts(held_and_fit):
    held, fit = held_and_fit
    assert fit.held_out_known_placement.labels == fit.held_out.labels == held
    assert (
        np.isfinite(fit.held_out_known_placement.pose).all()
        and fit.held_out_known_placement.soft_tissue is None
    )
    assert fit.held_out_known_placement.pose.mean() < 0.6 * fit.held_out.pose.mean()


def test_held_out_markers_have_no_say_in_these_places(planted, held_and_fit):
    """Moved by 4 cm in the capture that is judged, they change their own errors and nothing
    else.
    """
    held, fit = held_and_fit
    moved = capture(planted, slice(0, 8), "walk", moved=held)
    again = run(moved, capture(planted, slice(8, 24), "other"), hold_out=held)
    np.testing.assert_array_equal(again.pose, fit.pose)
    change = again.held_out_known_placement.pose - fit.held_out_known_placement.pose
    assert 0.01 < np.abs(change).max() < 0.04 + 1e-5


def test_what_the_other_lacks_has_no_number_and_is_said(planted, held_and_fit):
    held, _ = held_and_fit
    other = capture(planted, slice(8, 24), "other", without=held[:1])
    fit = run(capture(planted, slice(0, 8), "walk"), other, hold_out=held)
    assert (
        np.isnan(fit.held_out_known_placement.pose[:, 0]).all()
        and np.isfinite(fit.held_out_known_placement.pose[:, 1:]).all()
    )
    assert any(f"no placement there for {held[0]}" in warning for warning in fit.warnings)


def test_placements_that_cannot_be_used_are_refused(planted):
    one = capture(planted, slice(0, 8), "walk")
    other = capture(planted, slice(8, 24), "other", without=("C7",))
    with pytest.raises(HabitusError, match="none is held out: add hold-out-every K"):
        run(one, other)
    with pytest.raises(HabitusError, match="other has none of the held-out labels C7"):
        run(one, other, hold_out=("C7",))
