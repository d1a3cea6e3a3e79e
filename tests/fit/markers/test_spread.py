"""How well a fit knows the shape: between nothing and everything, as its markers allow."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from synthetic_fit import synthetic_fit, tube_body

from habitus.fit.markers.result import betas_covariance
from habitus.fit.markers.solution import UncertaintySettings


def sorted_variances(covariance: np.ndarray) -> np.ndarray:
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    return np.linalg.eigvalsh(covariance)


def test_markers_make_the_shape_surer_and_never_less_sure():
    variances = sorted_variances(betas_covariance(synthetic_fit(4)))
    assert variances.min() > 0 and variances.max() < 1 + 1e-9 and variances.min() < 0.9


def test_the_further_markers_may_be_off_the_less_is_known():
    fit = synthetic_fit(4)
    known = [
        sorted_variances(betas_covariance(fit, UncertaintySettings(place=place)))
        for place in (0.002, 0.01, 0.05, 10.0)
    ]
    assert all((a <= b + 1e-9).all() for a, b in pairwise(known))
    np.testing.assert_allclose(known[-1], 1, atol=1e-3)
    noisy = replace(fit, marker_noise=fit.marker_noise + 0.03)
    assert (
        sorted_variances(betas_covariance(noisy, UncertaintySettings(place=0.002)))
        >= known[0] - 1e-9
    ).all()


def test_what_no_marker_sees_stays_open():
    body = tube_body()
    shapedirs = body.shapedirs.copy()
    shapedirs[..., 2] = 0
    covariance = betas_covariance(synthetic_fit(4, body=replace(body, shapedirs=shapedirs)))
    np.testing.assert_allclose(covariance[2], np.eye(len(covariance))[2], atol=1e-9)


def test_more_frames_of_the_same_markers_tell_no_more():
    few = synthetic_fit(4)
    many = synthetic_fit(40)
    a, b = (np.trace(betas_covariance(fit, UncertaintySettings(place=0.02))) for fit in (few, many))
    assert abs(a - b) < 0.3
