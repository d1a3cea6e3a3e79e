"""What a fit gives: surfaces, joints and errors of frames."""

from dataclasses import replace

import numpy as np
from synthetic_fit import synthetic_fit


def test_vertices_and_joints_of_frames():
    fit = synthetic_fit(frames=40)
    whole = fit.vertices()
    joints = fit.joints()
    assert whole.shape == (40, fit.body.num_vertices, 3) and joints.shape == (
        40,
        fit.body.num_joints,
        3,
    )
    np.testing.assert_allclose(fit.vertices(-1), whole[-1], atol=1e-12)
    np.testing.assert_allclose(fit.vertices(slice(3, 30, 9)), whole[3:30:9], atol=1e-12)
    np.testing.assert_allclose(fit.joints([5, 2]), joints[[5, 2]], atol=1e-12)
    assert fit.vertices([]).shape == (0, fit.body.num_vertices, 3)


def test_errors_are_those_of_the_last_stage():
    fit = synthetic_fit(frames=20)
    rigid = synthetic_fit(frames=20, soft=False)
    np.testing.assert_array_equal(fit.errors_mm, 1e3 * fit.errors("soft_tissue"))
    np.testing.assert_array_equal(rigid.errors_mm, 1e3 * rigid.errors("pose"))
    assert np.isnan(fit.errors_mm).any() and "mm from the body on average" in str(fit.verdict)


def test_surfaces_come_in_order_a_few_frames_at_a_time():
    fit = synthetic_fit(frames=150)
    rows = np.arange(149, -1, -1)
    parts = [surface.vertices for surface in fit.surfaces(rows, [3, 4])]
    assert len(parts) > 1
    betas = fit.betas + fit.soft_tissue[rows]
    expected = fit.body(betas, fit.pose[rows], fit.trans[rows], vertices=[3, 4]).vertices
    np.testing.assert_allclose(np.concatenate(parts), expected, atol=1e-12)


def test_an_annotated_fit_keeps_what_was_judged():
    fit = synthetic_fit(frames=20)
    verdict, guessed = fit.verdict, fit.guessed
    noted = fit.annotated(warnings=("a note",), held_out=np.zeros(3), gender="female")
    assert noted.verdict is verdict and noted.guessed is guessed
    assert noted.warnings == ("a note",) and noted.gender == "female" and fit.gender != "female"
    afresh = replace(noted)
    assert "verdict" not in vars(afresh) and afresh.verdict == verdict
    assert "verdict" not in vars(synthetic_fit(frames=20).annotated(gender="male"))
