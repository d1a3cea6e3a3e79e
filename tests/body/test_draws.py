"""People drawn at random: skewed as the survey's, standardised, monotone in what was drawn."""

from dataclasses import replace

import numpy as np
import pytest

import habitus as hb
from habitus.body.draws import skewed


@pytest.mark.parametrize("skewness", [0.0, 0.1, 0.47, 1.2])
def test_skewed_numbers_have_unit_variance_and_the_skewness(skewness):
    # on a fine grid: no sampling error to allow for
    steps = np.linspace(-8, 8, 200_001)
    weights = np.exp(-(steps**2) / 2)
    weights /= weights.sum()
    drawn = skewed(steps, skewness)
    assert (np.diff(drawn) > 0).all()
    assert weights @ drawn == pytest.approx(0, abs=1e-6)
    assert weights @ drawn**2 == pytest.approx(1, abs=1e-6)
    assert weights @ drawn**3 == pytest.approx(skewness, abs=1e-5)


def test_drawn_betas_are_normal_without_skew_and_skewed_along_it_alone():
    body = replace(hb.load_body("female", num_betas=4), people_skew=None, finer=None)
    normal = np.random.default_rng(0).normal(size=(4000, 4))
    np.testing.assert_array_equal(body.draw_betas(4000, np.random.default_rng(0)), normal)
    skew = np.array([0.6, 0.0, -0.8, 0.0])
    drawn = replace(body, people_skew=skew).draw_betas(4000, np.random.default_rng(0))
    np.testing.assert_array_equal(drawn[:, [1, 3]], normal[:, [1, 3]])
    across = np.array([0.8, 0.0, 0.6, 0.0])
    np.testing.assert_allclose(drawn @ across, normal @ across, atol=1e-12)
    along = drawn @ skew
    assert (np.argsort(along) == np.argsort(normal @ skew)).all()
    assert ((along - along.mean()) ** 3).mean() / along.std() ** 3 == pytest.approx(1, abs=0.2)
