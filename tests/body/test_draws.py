"""People drawn at random: skewed as the survey's, standardised, monotone in what was drawn."""

from dataclasses import replace

import numpy as np
import pytest

import habitus as hb
from habitus.body.draws import skewed


@pytest.mark.parametrize("skewness", [-0.8, -0.1, 0.0, 0.3, 1.2])
def test_skewed_numbers_have_unit_variance_and_the_skewness(skewness):
    # at the quantiles of a fine grid: no sampling error to allow for but the tails'
    steps = np.linspace(-8, 8, 200_001)
    weights = np.exp(-(steps**2) / 2)
    weights /= weights.sum()
    drawn = skewed(steps[:, None], np.array([skewness]))[:, 0]
    assert (np.diff(drawn) > 0).all()
    assert weights @ drawn == pytest.approx(0, abs=1e-6)
    assert weights @ drawn**2 == pytest.approx(1, abs=1e-6)
    assert weights @ drawn**3 == pytest.approx(skewness, abs=1e-5)


def test_drawn_betas_are_normal_without_skew_and_skewed_with_it():
    body = replace(hb.load_body("female", num_betas=4), people_skew=None, finer=None)
    normal = np.random.default_rng(0).normal(size=(1000, 4))
    np.testing.assert_array_equal(body.draw_betas(1000, np.random.default_rng(0)), normal)
    skew = np.array([0.5, 0.0, -0.7, 0.0])
    drawn = replace(body, people_skew=skew).draw_betas(1000, np.random.default_rng(0))
    np.testing.assert_array_equal(drawn[:, [1, 3]], normal[:, [1, 3]])
    assert (np.argsort(drawn, 0) == np.argsort(normal, 0)).all()
    found = ((drawn - drawn.mean(0)) ** 3).mean(0) / drawn.std(0) ** 3
    assert found[0] > 0.3 and found[2] < -0.4
