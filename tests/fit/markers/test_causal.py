"""The causal fit: close to the whole sequence's optimum, steady over gaps and turns."""

import numpy as np
import pytest
from marker_scene import degrees_apart, fit, scene
from planted import fit as planted_fit
from planted import plant, settings

from habitus.fit.markers.causal import CausalSolver
from habitus.fit.markers.sequence import SequenceSettings
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


def test_the_first_frame_is_solved_to_its_end():
    """From far away as from its own solution."""
    s = scene(frames=1)
    (once,) = follow(s, s.observed)
    again = CausalSolver(s.rig, s.prior, once.pose, once.trans).step(s.observed[0])
    assert degrees_apart(once.pose[None], again.pose[None]) < 0.01


def test_it_depends_on_nothing_that_comes_later():
    s = scene(frames=30)
    changed = s.observed.copy()
    changed[20:] += 0.1
    early = follow(s, s.observed)[:20]
    later = follow(s, changed)[:20]
    np.testing.assert_array_equal([f.pose for f in early], [f.pose for f in later])


def test_it_keeps_on_over_a_gap():
    s = scene(frames=60)
    s.observed[30:35] = np.nan
    s.observed[40:, 3] = np.nan
    frames = follow(s, s.observed)
    misses = [
        np.abs(predict(s.rig, f.pose[None], f.trans[None])[0] - o)
        for f, o in zip(frames, s.observed, strict=True)
    ]
    assert np.nanmax(misses[40:]) < 0.02


def test_a_body_that_is_not_seen_moves_on_and_comes_to_rest():
    """Neither back to the prior's mean pose nor away for ever."""
    s = scene(frames=60)
    truth = predict(s.rig, s.pose, s.trans)
    s.observed[30:36] = np.nan
    places = np.array(
        [predict(s.rig, f.pose[None], f.trans[None])[0] for f in follow(s, s.observed)]
    )
    apart = [
        np.linalg.norm(each - truth[30:36], axis=2).mean() for each in (places[30:36], places[29])
    ]
    assert apart[0] < 0.5 * apart[1]
    blind = follow(
        s, np.concatenate([s.observed[:30], np.full((400, *s.observed.shape[1:]), np.nan)])
    )
    way = np.linalg.norm(np.diff([f.trans for f in blind], axis=0), axis=1)
    assert way[-1] < 1e-6 and way[29:].sum() < 20 * way[28]
    assert np.isfinite([f.cost for f in blind]).all()


def test_it_turns_on_and_on():
    s = scene(frames=300, seed=2)
    s.pose[:, 0] = np.linspace(0, 10 * np.pi, 300)[:, None] * np.array([0.0, 1.0, 0.0])
    observed = predict(s.rig, s.pose, s.trans)
    frames = follow(s, observed)
    assert max(np.linalg.norm(f.pose[0]) for f in frames) < 1.6 * np.pi
    for frame, seen in list(zip(frames, observed, strict=True))[5:]:
        np.testing.assert_allclose(
            predict(s.rig, frame.pose[None], frame.trans[None])[0], seen, atol=0.02
        )


def test_a_fallen_marker_is_weighed_down():
    s = scene(frames=40)
    clean = follow(s, s.observed)
    wrong = s.observed.copy()
    wrong[20:, 3] += (0.3, 0.0, 0.0)
    robust = follow(s, wrong, scales=np.full(25, 0.03))
    square = follow(s, wrong)
    apart = [degrees_apart(each[-1].pose, clean[-1].pose) for each in (robust, square)]
    assert apart[0] < 0.3 * apart[1]


def test_a_whole_fit_looks_ahead_and_a_causal_one_does_not():
    """Later frames are less complete, so that the shape stage takes none of them; then they are
    changed.
    """
    truth = plant(frames=30)
    observed = truth.observed.copy()
    observed[20:, :2] = np.nan
    changed = observed.copy()
    changed[20:] += 0.02 * np.random.default_rng(0).normal(size=changed[20:].shape)
    for causal in (True, False):
        which = settings(frames=4, annealing=(10.0,), causal=causal, soft_tissue=False)
        one, two = (planted_fit(truth, each, which) for each in (observed, changed))
        np.testing.assert_array_equal(one.betas, two.betas)
        assert (one.pose[:20] == two.pose[:20]).all() == causal and (
            one.trans[:20] == two.trans[:20]
        ).all() == causal
        assert (one.pose[20:] != two.pose[20:]).any()


def test_a_later_frame_leans_on_the_two_before_it():
    """With a heavy acceleration term a frame whose markers hardly count goes on at the speed of
    those before it.
    """
    s = scene(frames=12, noise=0.0)
    heavy = SequenceSettings(pose=1e-6, acceleration=50.0, trans_acceleration=50.0)
    solver = CausalSolver(s.rig, s.prior, s.pose[0], s.trans[0], heavy, iterations=20)
    frames = [
        solver.step(seen, np.full(25, 1e-9 if k >= 8 else 1.0))
        for k, seen in enumerate(s.observed[:10])
    ]
    pose = np.array([f.pose for f in frames])
    trans = np.array([f.trans for f in frames])
    np.testing.assert_allclose(pose[8:], 2 * pose[7:9] - pose[6:8], atol=1e-4)
    np.testing.assert_allclose(trans[8:], 2 * trans[7:9] - trans[6:8], atol=1e-4)


def test_a_frames_cost_is_its_own():
    """Data and prior by the formula, without what ties it to the frames before."""
    s = scene(frames=6)
    scales = np.full(25, 0.02)
    for frame, seen in zip(follow(s, s.observed, scales=scales), s.observed, strict=True):
        squared = np.sum(
            (predict(s.rig, frame.pose[None], frame.trans[None])[0] - seen) ** 2, axis=1
        )
        off = frame.pose[1:].ravel() - s.prior.mean
        data = 7500.0 * np.sum(squared / (1 + squared / scales**2))
        assert frame.cost == pytest.approx(0.5 * (data + off @ s.prior.precision @ off), rel=1e-5)
