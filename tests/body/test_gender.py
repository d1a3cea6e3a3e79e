"""P(female): as sure as the shape's own error allows, and no surer."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from synthetic_fit import tube_body

from habitus.body.gender import UNDECIDED, female_probability, said_of
from habitus.io.models.bodies import load_body, save_body

BODY = replace(tube_body(), female_direction=(np.array([2.0, -1.0, 0.5, 0.0, 1.0, 0.0]), 0.5))
BETAS = np.array([1.5, -1.0, 0.2, 0.0, 0.4, 2.0])
ROWS = (np.tril(np.arange(36.0).reshape(6, 6) - 15), np.arange(6.0) - 2)


def test_the_answer_is_the_mean_over_shapes_that_the_error_allows():
    rng = np.random.default_rng(0)
    root = rng.normal(0, 0.3, (6, 6))
    for covariance, around in (
        (0.5, BETAS + 0.5 * rng.normal(size=(200_000, 6))),
        (root @ root.T, BETAS + rng.normal(size=(200_000, 6)) @ root.T),
    ):
        score = around @ BODY.female_direction[0] + 0.5
        expected = np.mean(1 / (1 + np.exp(-score)))
        assert female_probability(BODY, BETAS, covariance) == pytest.approx(expected, abs=0.01)


def test_the_less_is_known_the_nearer_to_a_half():
    told = [female_probability(BODY, BETAS, error) for error in (0.0, 0.3, 1.0, 3.0, 100.0)]
    assert all(a > b for a, b in pairwise(told)) and told[-1] == pytest.approx(0.5, abs=0.02)


def test_a_body_without_the_classifier_gives_none():
    assert female_probability(tube_body(), BETAS) is None


def test_only_who_is_sure_says_something():
    assert [said_of(p) for p in (0.0, 0.19, 0.2, 0.5, 0.8, 0.81, 1.0)] == [
        *("male", "male"), *(UNDECIDED,) * 3, *("female", "female"),
    ]  # fmt: skip


def test_each_number_of_betas_has_a_classifier_of_its_own():
    body = replace(BODY, female_rows=ROWS, female_direction=(ROWS[0][-1], float(ROWS[1][-1])))
    for count in (1, 3, 6):
        few = body.with_betas(count)
        np.testing.assert_array_equal(few.female_direction[0], ROWS[0][count - 1, :count])
        assert few.female_direction[1] == ROWS[1][count - 1]
    twice = body.with_betas(4).with_betas(2)
    np.testing.assert_array_equal(twice.female_direction[0], ROWS[0][1, :2])
    np.testing.assert_array_equal(
        BODY.with_betas(2).female_direction[0], [2.0, -1.0]
    )  # weights alone are cut


def test_classifiers_are_saved_and_read_back(tmp_path):
    body = replace(
        load_body("default").with_betas(6), female_rows=ROWS, female_direction=(ROWS[0][-1], 3.0)
    )
    save_body(body, tmp_path / "body.npz")
    read = load_body(tmp_path / "body.npz")
    for a, b in zip(
        (*read.female_rows, read.female_direction[0]), (*ROWS, ROWS[0][-1]), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    assert read.female_direction[1] == 3.0
