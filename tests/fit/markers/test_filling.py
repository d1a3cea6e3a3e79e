"""Gaps filled from a fit: exactly where the marker moves with the skin, nowhere where nobody
knows.
"""

from dataclasses import replace

import numpy as np
from synthetic_fit import synthetic_fit

from habitus.fit.markers.gaps import fill_gaps
from habitus.fit.markers.suspects import Suspect
from habitus.observe.markers import MarkerAttachment, predict_markers


def _fit(frames=40):
    """A fit whose markers ride 4 mm beside their predicted places, in the axes of their
    triangles.
    """
    fit = synthetic_fit(frames, suspects=(), marker_weights=np.ones((frames, 12)))
    rng = np.random.default_rng(3)
    used, corners = np.unique(fit.attachment.triangles, return_inverse=True)
    beside = fit.attachment.coefficients + 0.004 * rng.normal(size=(12, 3))
    observed = predict_markers(fit.points(used), MarkerAttachment(corners.reshape(-1, 3), beside))
    return replace(fit, observed_markers=observed, flagged_frames=np.zeros(frames, bool)), observed


def test_a_marker_that_moves_with_the_skin_is_filled_exactly():
    fit, truth = _fit()
    gappy = truth.copy()
    gappy[5:20, 0], gappy[:7, 1], gappy[30:, 2] = np.nan, np.nan, np.nan
    found = fill_gaps(fit, gappy)
    np.testing.assert_allclose(found.markers, truth, atol=1e-9)
    np.testing.assert_array_equal(found.filled, np.isnan(gappy[..., 0]))
    assert [(gap.label, gap.first, gap.last, gap.why) for gap in found.gaps] == [
        ("M00", 5, 19, ""),
        ("M01", 0, 6, ""),
        ("M02", 30, 39, ""),
    ]


def test_what_was_seen_is_never_changed_and_the_join_is_smooth():
    fit, truth = _fit()
    slipped = truth.copy()
    slipped[20:, 0] += 0.006  # the skin slips while nobody looks
    gappy = slipped.copy()
    gappy[15:25, 0] = np.nan
    found = fill_gaps(fit, gappy)
    seen = np.isfinite(gappy)
    np.testing.assert_array_equal(found.markers[seen], gappy[seen])
    step = np.linalg.norm(np.diff(found.markers[:, 0] - truth[:, 0], axis=0), axis=1)
    assert step.max() < 0.002


def test_what_nobody_knows_stays_empty():
    fit, truth = _fit()
    gappy = truth.copy()
    gappy[5:10, :4], gappy[:, 4], gappy[12:15, 5] = np.nan, np.nan, np.nan
    weights = fit.marker_weights.copy()
    weights[10, 1] = 0.1
    flagged = np.zeros(len(truth), bool)
    flagged[12:15] = True
    told = (Suspect("M00", "fell", 9), Suspect("M02", "exchanged back", 9, corrected=True))
    fit = replace(fit, suspects=told, marker_weights=weights, flagged_frames=flagged)
    found = fill_gaps(fit, gappy, {"M03": "in pieces"})
    assert {gap.label: gap.why for gap in found.gaps} == {
        "M00": "under suspicion: fell",
        "M01": "the samples beside it do not lie on the body",
        "M02": "",
        "M03": "in pieces",
        "M04": "never seen",
        "M05": "too few markers are seen",
    }
    assert found.filled.any(axis=0).tolist() == [False, False, True] + [False] * 9
    assert np.isnan(found.markers[5:10, [0, 1, 3]]).all()
