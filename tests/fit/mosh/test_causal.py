"""The causal fit: close to the whole sequence's optimum, steady over gaps and turns."""

import numpy as np
from marker_scene import degrees_apart, fit, scene

from habitus.fit.mosh.causal import CausalSolver
from habitus.observe.marker_prediction import predict


def follow(s, observed, **options):
    solver = CausalSolver(s.rig, s.prior, s.pose[0] + 0.2, s.trans[0] + 0.05, **options)
    return [solver.step(frame) for frame in observed]


def test_it_follows_the_optimum_of_the_whole_sequence():
    s = scene(frames=60)
    whole = fit(s)
    frames = follow(s, s.observed)
    assert degrees_apart(np.array([f.pose for f in frames]), whole.pose) < 2.0
    np.testing.assert_allclose([f.trans for f in frames], whole.trans, atol=0.01)
    more = follow(s, s.observed, iterations=20)
    assert degrees_apart(np.array([f.pose for f in frames]), np.array([f.pose for f in more])) < 0.5


def test_it_depends_on_nothing_that_comes_later():
    s = scene(frames=30)
    changed = s.observed.copy()
    changed[20:] += 0.1
    early, later = follow(s, s.observed)[:20], follow(s, changed)[:20]
    np.testing.assert_array_equal([f.pose for f in early], [f.pose for f in later])


def test_it_keeps_on_over_a_gap():
    s = scene(frames=60)
    s.observed[30:35] = np.nan
    s.observed[40:, 3] = np.nan
    frames = follow(s, s.observed)
    misses = [
        np.abs(predict(s.rig, f.pose[None], f.trans[None])[0] - o) for f, o in zip(frames, s.observed, strict=True)
    ]
    assert np.nanmax(misses[40:]) < 0.02


def test_it_turns_on_and_on():
    s = scene(frames=300, seed=2)
    s.pose[:, 0] = np.linspace(0, 10 * np.pi, 300)[:, None] * np.array([0.0, 1.0, 0.0])
    observed = predict(s.rig, s.pose, s.trans)
    frames = follow(s, observed)
    assert max(np.linalg.norm(f.pose[0]) for f in frames) < 1.6 * np.pi
    for frame, seen in list(zip(frames, observed, strict=True))[5:]:
        np.testing.assert_allclose(predict(s.rig, frame.pose[None], frame.trans[None])[0], seen, atol=0.02)


def test_a_fallen_marker_is_weighed_down():
    s = scene(frames=40)
    clean = follow(s, s.observed)
    wrong = s.observed.copy()
    wrong[20:, 3] += (0.3, 0.0, 0.0)
    robust, square = follow(s, wrong, scales=np.full(25, 0.03)), follow(s, wrong)
    apart = [degrees_apart(each[-1].pose, clean[-1].pose) for each in (robust, square)]
    assert apart[0] < 0.3 * apart[1]
