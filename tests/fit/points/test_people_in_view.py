"""Several people in one depth image: each gets a mask of their own."""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_scene_small import small_scene

from habitus.errors import HabitusError
from habitus.fit.points.people_in_view import people_in, split_people
from habitus.observe.camera import DepthView


def _shifted(shift: int, farther: float = 0.0) -> tuple[DepthView, np.ndarray, np.ndarray]:
    """A view with a copy of its person so many columns to the right, and who is where."""
    _, scene = small_scene()
    view = scene.capture.views[0]
    person = (view.background > 0) & (view.depth > 0) & (view.background - view.depth > 0.1)
    other = np.roll(np.where(person, view.depth + farther, np.inf), shift, axis=1)
    depth = np.minimum(np.where(view.depth > 0, view.depth, np.inf), other)
    depth[~np.isfinite(depth)] = 0.0
    both = replace(view, depth=depth, background=None, background_colour=None)
    front = other < np.where(person, view.depth, np.inf)
    return both, person & ~front, np.isfinite(other) & front


def _overlap(mask: np.ndarray, other: np.ndarray) -> float:
    return float((mask & other).sum() / (mask | other).sum())


@pytest.mark.parametrize(("share", "farther"), [(0.33, 0.0), (0.16, 0.25), (0.2, -0.3)])
def test_each_person_has_a_mask(share, farther):
    view, one, other = _shifted(
        int(share * small_scene()[1].capture.views[0].depth.shape[1]), farther
    )
    found = people_in(view)
    assert len(found) == 2 and not (found[0] & found[1]).any()
    assert _overlap(found[0], one) > 0.6 and _overlap(found[1], other) > 0.6


def test_arms_held_up_do_not_make_two_people():
    """A hand as high as a head has no body below it."""
    view, person, _ = _shifted(0)
    rows, columns = np.nonzero(person)
    across = columns.mean()
    top = rows.min()
    arm = (np.abs(np.arange(view.depth.shape[1]) - across - 0.22 * np.ptp(rows)) < 2)[None]
    arm = arm & (np.arange(len(view.depth)) >= top)[:, None]
    arm &= (np.arange(len(view.depth)) < top + 0.25 * np.ptp(rows))[:, None]
    depth = np.where(arm, np.median(view.depth[person]), view.depth)
    assert len(people_in(replace(view, depth=depth))) == 1


def test_captures_are_of_one_person_each():
    view, _, _ = _shifted(int(0.33 * small_scene()[1].capture.views[0].depth.shape[1]))
    capture = replace(small_scene()[1].capture, views=(view,))
    names = [each.name for each in split_people(capture)]
    assert names == [f"{capture.name}-1", f"{capture.name}-2"]
    assert all(each.views[0].mask is not None for each in split_people(capture))


def test_an_empty_room_and_several_views_are_refused():
    _, scene = small_scene()
    view = scene.capture.views[0]
    with pytest.raises(HabitusError, match="nobody was found"):
        people_in(replace(view, depth=view.background, background=None))
    with pytest.raises(HabitusError, match="2 views; expected one"):
        split_people(scene.capture)
