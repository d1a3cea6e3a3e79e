"""The whole-sequence stages minimise the stated formula: each term by hand, and weights that mean
what they say.
"""

import numpy as np
import pytest
from marker_scene import fit, scene

from habitus.observe.marker_prediction import predict

WEIGHTS = {"data": 5000.0, "pose": 0.7, "acceleration": 3.0, "trans_acceleration": 4.0}
SOFT = {"soft_tissue_acceleration": 2.0}


@pytest.fixture(scope="module")
def solved():
    s = scene(frames=15)
    s.observed[3, 5] = np.nan
    s.observed[10, :3] = np.nan
    weights = s.rng.uniform(0.2, 1.0, size=s.observed.shape[:2])
    scales = np.full(25, 0.02)
    return s, weights, scales, fit(s, None, np.zeros((15, 4)), weights, scales, **WEIGHTS, **SOFT)


def test_each_term_costs_what_its_formula_says(solved):
    s, weights, scales, result = solved
    miss = predict(s.rig, result.pose, result.trans, result.soft_tissue) - s.observed
    squared = np.sum(miss**2, axis=2)
    data = weights * squared * scales**2 / (scales**2 + squared)
    off = result.pose[:, 1:].reshape(15, -1) - s.prior.mean
    bends = [
        np.sum(np.diff(part, 2, axis=0) ** 2)
        for part in (result.pose, result.trans, result.soft_tissue)
    ]
    assert result.costs["data"] == pytest.approx(0.5 * 5000.0 * np.nansum(data), rel=1e-9)
    assert result.costs["pose"] == pytest.approx(
        0.5 * 0.7 * np.sum((off @ s.prior.precision) * off), rel=1e-6
    )
    assert result.costs["soft_tissue"] == pytest.approx(
        0.5 * 0.25 * np.sum(result.soft_tissue**2), rel=1e-9
    )
    assert result.costs["acceleration"] == pytest.approx(
        0.5 * np.dot([3.0, 4.0, 2.0], bends), rel=1e-9
    )
    shrink = (scales**2 / (scales**2 + squared)) ** 2
    np.testing.assert_allclose(result.weights, np.nan_to_num(weights * shrink), rtol=1e-9)


def test_a_change_of_shape_is_smoother_the_heavier_its_acceleration(solved):
    s, weights, scales, loose = solved
    firm = fit(
        s, None, np.zeros((15, 4)), weights, scales, **WEIGHTS, soft_tissue_acceleration=200.0
    )
    rough = [np.sum(np.diff(result.soft_tissue, 2, axis=0) ** 2) for result in (loose, firm)]
    assert rough[1] < 0.1 * rough[0]


def test_a_weight_of_zero_is_as_if_the_marker_were_missing():
    s = scene(frames=8)
    hidden = np.zeros((8, 25), dtype=bool)
    hidden[2:5, [3, 7]] = True
    gaps = np.where(hidden[..., None], np.nan, s.observed)
    results = []
    for observed, weights in ((s.observed, np.where(hidden, 0.0, 1.0)), (gaps, None)):
        s.rng = np.random.default_rng(1)
        results.append(fit(s, observed, weights=weights))
    np.testing.assert_array_equal(results[0].pose, results[1].pose)
    np.testing.assert_array_equal(results[0].weights, results[1].weights)


def test_endless_scales_are_squares():
    s = scene(frames=8)
    results = []
    for scales in (None, np.full(25, np.inf)):
        s.rng = np.random.default_rng(1)
        results.append(fit(s, scales=scales))
    np.testing.assert_array_equal(results[0].pose, results[1].pose)
    np.testing.assert_array_equal(results[0].weights, np.ones((8, 25)))
