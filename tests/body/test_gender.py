"""P(female): as sure as the shape's own error allows, and no surer."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from synthetic_fit import tube_body

from habitus.body.gender import SURVEY_OFFSET, SURVEY_SLOPE, female_probability

BODY = replace(tube_body(), female_direction=(np.array([2.0, -1.0, 0.5, 0.0, 1.0, 0.0]), 0.5))
BETAS = np.array([1.5, -1.0, 0.2, 0.0, 0.4, 2.0])


def test_the_answer_is_the_mean_over_shapes_that_the_error_allows():
    error, weights = 0.5, BODY.female_direction[0]
    around = BETAS + error * np.random.default_rng(0).normal(size=(200_000, len(BETAS)))
    score = SURVEY_SLOPE * (around @ weights + 0.5) + SURVEY_OFFSET
    assert female_probability(BODY, BETAS, error) == pytest.approx(np.mean(1 / (1 + np.exp(-score))), abs=0.01)


def test_the_less_is_known_the_nearer_to_a_half():
    told = [female_probability(BODY, BETAS, error) for error in (0.0, 0.3, 1.0, 3.0, 100.0)]
    assert all(a > b for a, b in pairwise(told)) and told[-1] == pytest.approx(0.5, abs=0.02)


def test_a_body_without_the_classifier_gives_none():
    assert female_probability(tube_body(), BETAS) is None
