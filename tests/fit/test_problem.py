"""Laws of `habitus.Fit`: sensors of one person help each other, terms of one's own join, refusals."""

import importlib.util
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import habitus as hb
from habitus.fit.body_fit import JointStage

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
QUICK = hb.FitSettings(
    frames=4,
    motion=False,
    stages=(JointStage(0.06, 2.0, iterations=5), JointStage(0.03, 1.0, "pixel", iterations=8)),
)
SHOTS = (0, 30)


@cache
def example():
    spec = importlib.util.spec_from_file_location("two_sensors", EXAMPLES / "two_sensors.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["two_sensors"] = module
    spec.loader.exec_module(module)
    return module


@cache
def body():
    return hb.load_body("default").with_betas(6)


@cache
def person(seed):
    return example().person(body(), seed)


def shape_error(fit, truth):
    off = body().rest_vertices(fit.betas) - body().rest_vertices(truth[0])
    return np.linalg.norm(off, axis=1).mean()


def joint_error(fit, truth, frames):
    off = [
        fit.joints(f"frame {k}") - body()(truth[0], truth[1][k], truth[2][k]).joints for k in frames
    ]
    return np.linalg.norm(off, axis=2).mean()


@cache
def by_markers(seed):
    _, markers, _ = person(seed)
    return hb.Fit(body(), replace(markers, frames=SHOTS), QUICK).solve()


def test_views_of_the_capture_better_shape_and_pose():
    """Over the mean of three people, and the shape better than views alone give it."""
    errors = []
    for seed in range(3):
        truth, markers, views = person(seed)
        alone = by_markers(seed)
        both = hb.Fit(body(), [markers, hb.Depth(views, frames=SHOTS)], QUICK).solve()
        assert both.status in ("converged", "iterations") and both.motion is None
        assert sum(both.costs.values()) < np.inf and {"depth 1", "markers"} <= set(both.costs)
        errors.append(
            [shape_error(alone, truth), shape_error(both, truth)]
            + [joint_error(fit, truth, SHOTS) for fit in (alone, both)]
        )
    shape_alone, shape_both, joints_alone, joints_both = np.mean(errors, axis=0)
    assert shape_both < 0.9 * shape_alone
    assert joints_both < 0.6 * joints_alone and joints_both < 0.01


def test_views_alone_are_fitted_in_their_cameras_frames():
    truth, _, views = person(0)
    fit = hb.Fit(body(), hb.Depth(views), QUICK).solve()
    assert fit.poses == ("view 0", "view 1") and fit.pose.shape[0] == 2
    assert shape_error(fit, truth) < 0.02
    camera = views[0].camera
    for k, shot in enumerate(SHOTS):
        joints = np.asarray(body()(truth[0], truth[1][shot], truth[2][shot]).joints)
        turn = np.diag([1.0, -1.0, -1.0])
        seen = joints @ turn.T + camera.translation.numpy()
        assert np.linalg.norm(fit.joints(k) - seen, axis=1).mean() < 0.02


def test_a_scan_in_the_captures_world_gives_the_shape_and_the_capture_its_motion():
    truth, markers, _ = person(1)
    vertices = np.asarray(body()(truth[0], truth[1][20], truth[2][20]).vertices)
    scan = hb.Scan((vertices, body().faces), frame=20)
    settings = replace(QUICK, motion=True, mosh=replace(QUICK.mosh, soft_tissue=False))
    fit = hb.Fit(body(), [scan, markers], settings).solve()
    assert shape_error(fit, truth) < 0.002 < shape_error(by_markers(1), truth)
    assert fit.residuals_mm["scan 0"]["median"] < 2.0
    assert fit.motion.num_frames == len(truth[1]) and "markers" in fit.verdicts
    np.testing.assert_array_equal(fit.motion.betas, fit.betas)
    assert fit.motion.errors_mm[np.isfinite(fit.motion.errors_mm)].mean() < 5.0


def test_points_without_normals_do_as_well():
    truth, markers, _ = person(1)
    vertices = np.asarray(body()(truth[0], truth[1][20], truth[2][20]).vertices)
    fit = hb.Fit(body(), [hb.Scan(vertices[::3], frame=20), markers], QUICK).solve()
    assert shape_error(fit, truth) < 0.003


def test_a_term_of_ones_own_joins_the_others():
    """A floor that is higher than the soles lifts them, and its cost is told."""
    _, markers, _ = person(0)
    alone = by_markers(0)
    foot = body().joint_names.index("left_foot")
    height = float(alone.joints(0)[foot, 1]) + 0.05

    def lifted(betas, pose, trans):
        joints = body()(betas, pose, trans, vertices=[0]).joints
        return (height - joints[:, foot, 1]).clip(0.0, None)

    fit = hb.Fit(
        body(), replace(markers, frames=SHOTS), QUICK, {"floor": hb.Term(lifted, weight=1e6)}
    ).solve()
    assert "floor" in fit.costs
    assert fit.joints(0)[foot, 1] > alone.joints(0)[foot, 1] + 0.02


@pytest.mark.parametrize(
    ("sensors", "word"),
    [
        (lambda markers, views: [], "no sensor"),
        (lambda markers, views: [markers, markers], "2 captures"),
        (lambda markers, views: [hb.Depth(views, frames=SHOTS)], "without a capture"),
        (lambda markers, views: [markers, hb.Depth(views, frames=(0, 99))], "frame 99"),
        (lambda markers, views: [markers, hb.Depth(views, frames=(0,))], "1 frames for 2"),
        (lambda markers, views: ["walk.c3d"], "str"),
        (lambda markers, views: replace(markers, layout="auto"), "layout"),
        (lambda markers, views: replace(markers, capture=markers.capture[:, :5]), "12"),
    ],
)
def test_what_cannot_be_fitted_is_refused(sensors, word):
    _, markers, views = person(0)
    with pytest.raises(hb.HabitusError, match=word):
        hb.Fit(body(), sensors(markers, views), QUICK).solve()


def test_a_term_named_as_another_is_refused():
    _, markers, _ = person(0)
    with pytest.raises(hb.HabitusError, match="rename"):
        hb.Fit(body(), markers, QUICK, {"betas": lambda betas: betas}).solve()
