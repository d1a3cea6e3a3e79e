"""A body recentred on a character: its rest is the character, all else the body's, as much larger
as it is taller.
"""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import tube_body

from habitus.body.recentred import FROM, recentred, recentred_arrays
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body


def test_its_own_template_gives_the_same_body():
    body = tube_body(posedirs=True)
    same = recentred(body, body.v_template, "same")
    pose = 0.2 * np.random.default_rng(0).normal(size=(24, 3))
    np.testing.assert_array_equal(same([0.5, 1.0], pose).vertices, body([0.5, 1.0], pose).vertices)
    assert same.name == "same" and str(same.extras[FROM]) == "tubes" and not recentred_arrays(body)


def test_twice_as_large_is_twice_as_large_in_every_pose():
    body = tube_body(posedirs=True)
    rng = np.random.default_rng(1)
    giant = recentred(body, 2 * body.v_template, "giant")
    pose = 0.3 * rng.normal(size=(24, 3))
    betas = rng.normal(size=body.num_betas)
    np.testing.assert_allclose(
        giant(betas, pose).vertices, 2 * body(betas, pose).vertices, atol=1e-12
    )
    np.testing.assert_allclose(giant(betas, pose).joints, 2 * body(betas, pose).joints, atol=1e-12)


def test_both_levels_of_detail_are_the_character():
    body = load_body("default")
    full = body.full.v_template * [1.1, 0.9, 1.2]
    found = recentred(body, full, "hero")
    np.testing.assert_array_equal(found.full.v_template, full)
    np.testing.assert_array_equal(found.v_template, full[body.full_vertices])
    np.testing.assert_array_equal(recentred_arrays(found)["character_vertices"], full)
    assert found.people_mean is None and found.ages is None and found.female_direction is None
    assert recentred(body, found.v_template, "coarse").full is None


def test_what_is_no_character_is_refused():
    body = tube_body()
    with pytest.raises(HabitusError, match=r"register"):
        recentred(body, body.v_template[:-1], "x")
    with pytest.raises(HabitusError, match="metres"):
        recentred(body, 1000 * body.v_template, "x")
    with pytest.raises(HabitusError, match="T-pose"):
        recentred(body, body((), {"left_shoulder": (0, 0, -0.9)}).vertices, "x")
    with pytest.raises(HabitusError, match="metres"):
        recentred(replace(body), np.full_like(body.v_template, np.nan), "x")
