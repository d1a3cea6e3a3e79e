"""The whole-sequence marker fit: fast and plain forms, SciPy's optimum, planted truth, outliers,
gaps, turns.
"""

import numpy as np
import pytest
import scipy.optimize
from marker_scene import DoubleSequence, degrees_apart, fit, scene

from habitus.errors import HabitusError
from habitus.fit.markers.marker_sequence import DenseSequence, KernelSequence
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.observe.marker_prediction import predict
from habitus.solve.sequence import SequenceOptions, solve_sequence

TIGHT = SequenceOptions(strides=(1,), tolerance=1e-9, cost_tolerance=0.0, sweeps=3000)


KINDS = [{}, {"posedirs": True}, {"joints": 9, "influences": 4}, {"joints": 1, "influences": 1}]
FOLDED = {"posedirs": True, "drivers": (4, 2)}


@pytest.mark.parametrize(
    ("kind", "betas"),
    [
        *((kind, betas) for kind in KINDS for betas in (0, 4)),
        (FOLDED | {"hinge_shapes": 2}, 0),
        (FOLDED | {"hinge_shapes": 2}, 4),
        (FOLDED | {"hinge_shapes": 0}, 4),
    ],
)
@pytest.mark.parametrize(("kernels", "digit"), [(DoubleSequence, 1e-13), (KernelSequence, 1e-6)])
def test_compiled_and_dense_visits_agree(kind, betas, kernels, digit):
    """Costs, and with them gradients and matrices: a Gauss-Newton step of either leads to the same
    place.
    """
    s = scene(frames=13, seed=4, **kind)
    scales = np.where(np.arange(25) % 2, 0.02, np.inf)
    s.observed[3, 5] = np.nan
    weights = s.rng.uniform(size=s.observed.shape[:2])
    problem = (s.observed, weights, scales, s.prior, SequenceSettings(), betas)
    fast = kernels(s.rig, *problem)
    plain = DenseSequence(s.marked, *problem)
    start = fast.pack(
        s.pose + 0.1, s.trans, 0.3 * s.rng.normal(size=(13, betas)) if betas else None
    )
    frames = np.arange(13)
    np.testing.assert_allclose(fast.cost(frames, start), plain.cost(frames, start), rtol=10 * digit)
    options = SequenceOptions(strides=(1,), sweeps=2, damping=3.0)
    ends = [solve_sequence(each, start, slice(3, fast.pose_end), options) for each in (fast, plain)]
    np.testing.assert_allclose(ends[0].states, ends[1].states, atol=1e4 * digit)
    np.testing.assert_allclose(ends[0].frame_costs, ends[1].frame_costs, rtol=1e4 * digit)
    np.testing.assert_allclose(ends[0].history, ends[1].history, rtol=1e4 * digit)


@pytest.mark.parametrize("posedirs", [False, True])
@pytest.mark.parametrize("scale", [np.inf, 0.02])
def test_the_optimum_is_scipys(posedirs, scale):
    s = scene(frames=5, seed=1, posedirs=posedirs, joints=4)
    s.observed[2, :20] = np.nan
    result = fit(s, scales=np.full(25, scale), options=TIGHT)
    settings = SequenceSettings()
    root = np.linalg.cholesky(s.prior.precision).T

    def residual(flat):
        states = flat.reshape(5, -1)
        pose = states[:, 3:].reshape(5, -1, 3)
        miss = np.nan_to_num(predict(s.rig, pose, states[:, :3]) - s.observed)
        shrink = 1 / np.sqrt(1 + np.sum(miss**2, axis=2, keepdims=True) / scale**2)
        bend = np.diff(states, 2, axis=0)
        terms = [
            np.sqrt(settings.data) * shrink * miss,
            (states[:, 6:] - s.prior.mean) @ root.T,
            np.sqrt(settings.acceleration) * bend[:, 3:],
            np.sqrt(settings.trans_acceleration) * bend[:, :3],
        ]
        return np.concatenate([term.ravel() for term in terms])

    found = np.concatenate([result.trans, result.pose.reshape(5, -1)], axis=1)
    peer = scipy.optimize.least_squares(
        residual, found.ravel() + 1e-3, xtol=1e-12, ftol=1e-14, gtol=1e-10
    )
    assert sum(result.costs.values()) <= peer.cost * (1 + 1e-6)
    np.testing.assert_allclose(found.ravel(), peer.x, atol=2e-4)


def test_frames_cost_what_the_terms_sum_to():
    s = scene()
    result = fit(s, soft_tissue=np.zeros((12, 4)))
    own = sum(cost for name, cost in result.costs.items() if name != "acceleration")
    np.testing.assert_allclose(result.frame_costs.sum(), own, rtol=1e-6)
    np.testing.assert_allclose(result.history[-1], sum(result.costs.values()), rtol=1e-6)


def test_where_the_person_stands_does_not_matter():
    """Kilometres from the origin, where float32 holds no millimetre."""
    here = fit(scene(frames=30))
    s = scene(frames=30)
    away = np.array([4000.0, -7000.0, 300.0])
    s.observed += away
    s.trans += away
    there = fit(s)
    np.testing.assert_allclose(there.pose, here.pose, atol=1e-4)
    np.testing.assert_allclose(there.trans - away, here.trans, atol=1e-5)


def test_planted_truth_is_found():
    s = scene(frames=70, noise=1e-5)
    s.observed[s.rng.random(s.observed.shape[:2]) < 0.05] = np.nan
    result = fit(s, pose=1e-6, acceleration=1e-6)
    assert result.status == "converged"
    assert degrees_apart(result.pose, s.pose) < 0.2
    np.testing.assert_allclose(result.trans, s.trans, atol=1e-3)


def test_soft_tissue_takes_up_a_change_of_shape():
    s = scene(frames=40, noise=1e-4)
    truth = 0.5 * np.sin(np.arange(40) / 7)[:, None] * np.array([1.0, -0.5, 0.3, 0.2])
    observed = predict(s.rig, s.pose, s.trans, truth)
    stiff = fit(s, observed=observed, pose=1e-4, acceleration=1e-3)
    start = np.zeros((40, 4))
    soft = fit(s, observed=observed, soft_tissue=start, pose=1e-4, acceleration=1e-3)
    assert soft.costs["data"] < 0.1 * stiff.costs["data"]
    assert np.abs(soft.soft_tissue - truth).max() < 0.1


def test_a_fallen_marker_is_weighed_down():
    s = scene(frames=30)
    wrong = s.observed.copy()
    wrong[10:20, 3] += (0.3, 0.0, 0.0)
    clean = fit(s)
    robust = fit(s, observed=wrong, scales=np.full(25, 0.03))
    square = fit(s, observed=wrong)
    assert robust.weights[10:20, 3].max() < 0.02
    assert np.delete(robust.weights[10:20], 3, axis=1).min() > 0.7
    assert degrees_apart(robust.pose, clean.pose) < 0.3 * degrees_apart(square.pose, clean.pose)


def test_frames_without_any_marker_are_bridged():
    s = scene(frames=40)
    observed = s.observed.copy()
    observed[20:26] = np.nan
    result = fit(s, observed=observed)
    assert np.isfinite(result.pose).all() and (result.weights[20:26] == 0).all()
    np.testing.assert_allclose(result.trans[20:26], s.trans[20:26], atol=0.05)


def test_a_capture_without_markers_does_not_fail():
    s = scene(frames=6)
    result = fit(s, observed=np.full_like(s.observed, np.nan))
    assert np.isfinite(result.pose).all() and result.costs["data"] == 0.0


@pytest.mark.parametrize("turns", [5, -5])
def test_several_whole_turns(turns):
    """A pirouette: the root passes 1.5 pi again and again, and rotation vectors begin anew
    there.
    """
    s = scene(frames=300, seed=2)
    s.pose[:, 0] = (
        np.linspace(0, 2 * np.pi * turns, 300)[:, None] * np.array([0.0, 1.0, 0.0])
        + 0.05 * s.pose[:, 0]
    )
    observed = predict(s.rig, s.pose, s.trans)
    result = fit(s, observed=observed)
    assert result.status == "converged"
    assert np.linalg.norm(result.pose[:, 0], axis=1).max() < 1.6 * np.pi
    np.testing.assert_allclose(predict(s.rig, result.pose, result.trans), observed, atol=0.01)


def test_frames_apart_do_not_know_of_each_other():
    s = scene(frames=9)
    order = s.rng.permutation(9)
    settings = SequenceSettings(acceleration=0.0, options=TIGHT)
    start = s.pose + 0.1
    one = fit_sequence(s.rig, s.observed, None, None, s.prior, start, s.trans, settings)
    two = fit_sequence(
        s.rig, s.observed[order], None, None, s.prior, start[order], s.trans[order], settings
    )
    np.testing.assert_allclose(one.pose[order], two.pose, atol=1e-9)


def test_threads_change_nothing(monkeypatch):
    s = scene(frames=90)
    results = []
    for threads in (1, 2, 3):
        monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", threads)
        s.rng = np.random.default_rng(0)
        results.append(fit(s).pose)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def test_wrong_shapes_are_refused():
    s = scene(frames=3)
    with pytest.raises(HabitusError, match="observed markers"):
        fit(s, observed=s.observed[:, :4])
    s.prior.mean = s.prior.mean[3:]
    with pytest.raises(HabitusError, match="pose prior"):
        fit(s)


def test_a_start_far_off_is_mended_by_neighbours():
    """Every joint starts 45 degrees off, anyhow: key frames that get stuck begin again from ones
    that did not.
    """
    s = scene(frames=120, markers=40, seed=5)
    truth = fit(s)
    axes = s.rng.normal(size=s.pose.shape)
    start = s.pose + np.radians(45) * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    result = fit_sequence(s.rig, s.observed, None, None, s.prior, start, s.trans)
    assert sum(result.costs.values()) <= 1.001 * sum(truth.costs.values())
