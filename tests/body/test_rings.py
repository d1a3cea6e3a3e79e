"""Material rings: a tape around fixed places of a skin."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.body.tapes import cut

TUBE = trimesh.creation.cylinder(0.1, 1, sections=128)
HERE = np.array([0, 0, 0.013])
UP = np.array([0, 0, 1.0])


@settings(max_examples=20, deadline=None)
@given(st.floats(0.2, 3), st.floats(0.2, 3))
def test_a_stretched_tube_measures_as_an_ellipse_does(a, b):
    ring = cut(TUBE.vertices, TUBE.faces, HERE, UP)
    h = ((a - b) / (a + b)) ** 2
    ramanujan = np.pi * 0.1 * (a + b) * (1 + 3 * h / (10 + np.sqrt(4 - 3 * h)))
    stretched = TUBE.vertices * [a, b, 1]
    assert ring.length(stretched) == pytest.approx(ramanujan, rel=2e-3)
    assert ring.extent(stretched, np.array([1.0, 0, 0])) == pytest.approx(0.2 * a, rel=2e-3)


def test_a_ring_goes_with_the_skin_and_never_looks_for_its_loop_again():
    ring = cut(TUBE.vertices, TUBE.faces, HERE, UP)
    moved = TUBE.vertices + np.array(
        [3.0, -1.0, 7.0]
    )  # a plane through the old place would find nothing
    assert cut(moved, TUBE.faces, HERE, UP) is None
    assert ring.length(moved) == pytest.approx(ring.length(TUBE.vertices))


def test_people_are_measured_together():
    ring = cut(TUBE.vertices, TUBE.faces, HERE, UP)
    several = TUBE.vertices * np.array([1.0, 1.5, 2.0])[:, None, None]
    assert ring.length(several) == pytest.approx(
        ring.length(TUBE.vertices) * np.array([1.0, 1.5, 2.0])
    )


def test_the_drawn_tape_is_as_long_as_it_measures():
    ring = cut(TUBE.vertices, TUBE.faces, HERE, UP)
    tape = ring.tape(TUBE.vertices)
    drawn = np.linalg.norm(tape - np.roll(tape, -1, axis=0), axis=1).sum()
    assert drawn == pytest.approx(ring.length(TUBE.vertices), rel=1e-4)


def test_all_loops_or_the_nearest_one():
    both = trimesh.util.concatenate([TUBE, TUBE.copy().apply_translation([1, 0, 0])])
    one, all_ = (cut(both.vertices, both.faces, HERE, UP, whole) for whole in (False, True))
    assert 2 * len(one.share) == len(all_.share)
    assert all_.length(both.vertices) == pytest.approx(2 + 2 * np.pi * 0.1, rel=1e-3)  # around both
    assert one.middle(both.vertices, 1e-9) is None or np.allclose(
        one.points(both.vertices)[:, 0].max(), 0.1, atol=1e-3
    )
