"""What keeps its distance is one part; names that come in pairs say sides."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from habitus.fit.discover.description import agreement, companions, named_sides


def moving(frames=12, seed=0):
    rng = np.random.default_rng(seed)
    parts = [rng.normal(scale=0.1, size=(4, 3)) for _ in range(3)]
    turns = [Rotation.random(frames, random_state=seed + k).as_matrix() for k in range(3)]
    places = [t @ part.T for t, part in zip(turns, parts, strict=True)]
    return np.concatenate(
        [np.swapaxes(p, 1, 2) + rng.normal(size=(frames, 1, 3)) for p in places], axis=1
    )


def test_markers_of_one_part_keep_each_other_company():
    for column, mates in enumerate(companions(moving())):
        assert set(mates) == set(range(column // 4 * 4, column // 4 * 4 + 4)) - {column}


def test_nobody_is_told_apart_where_nothing_moves():
    still = np.repeat(np.random.default_rng(1).normal(size=(1, 6, 3)), 9, axis=0)
    assert companions(still) == [()] * 6


@pytest.mark.parametrize("form", ["{}THI{}", "my_{}_hip{}", "{}.{}"])
@pytest.mark.parametrize("pair", [("L", "R"), ("left", "right"), ("LEFT", "RIGHT")])
def test_pairs_of_names_say_sides(form, pair):
    labels = [form.format(side, k) for k in range(3) for side in pair]
    np.testing.assert_array_equal(named_sides([*labels, "C7"]), [1, -1] * 3 + [0])


def test_names_without_partners_say_nothing():
    assert not named_sides(["LEFTOVER", "RIB", "L5", "LAMP", "ROSE", "m01", "LA", "RA"]).any()


def test_agreement_counts_the_sides_that_are_told():
    sides = named_sides(["LA", "RA", "LB", "RB", "LC", "RC", "C7"])
    across = np.array([0.2, -0.2, 0.2, -0.2, 0.2, 0.2, 0.0])
    assert agreement(sides, across) == pytest.approx(5 / 6)
    assert agreement(sides, -across) == pytest.approx(1 / 6)
    assert agreement(np.zeros(7), across) is None
