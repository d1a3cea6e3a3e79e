"""Sensors of one kind are fitted by the recipe of that kind, and what cannot be fitted is refused
in one line.
"""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_scene_small import QUICK_DEPTH
from sensor_people import (
    MOSH,
    QUICK,
    QUICK_SCANS,
    SHOTS,
    body,
    halves,
    joint_error,
    person,
    scan_of,
)

import habitus as hb
from habitus.observe.camera import RgbdCapture
from habitus.observe.keypoints import KeypointRig, convention_names
from habitus_lab.population.camera_scenes import detected, ring


def same(found, expected, *names):
    for name in names:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def test_captures_alone_are_what_mosh_makes_of_them():
    _, captures = halves(1)
    fit = hb.Fit(body(), captures, QUICK).solve()
    recipe = hb.Mosh(layout=captures[0].layout, settings=MOSH, soft_tissue="none")
    expected = recipe.fit([each.read() for each in captures], body())
    assert fit.results == fit.motions and len(fit.results) == 2
    for found, one in zip(fit.results, expected, strict=True):
        same(found, one, "betas", "latent_markers", "pose", "trans", "predicted_pose_stage")
        assert (found.costs, found.status, found.verdict) == (one.costs, one.status, one.verdict)
    np.testing.assert_array_equal(fit.pose, np.concatenate([one.pose for one in expected]))


def test_scans_alone_are_what_register_scans_makes_of_them():
    scan = scan_of(0, 0)
    fit = hb.Fit(body(), scan, QUICK).solve()
    (expected,) = hb.register_scans(scan.scan, body(), up="+y", unit="m", settings=QUICK_SCANS)
    (found,) = fit.results
    same(found, expected, "betas", "pose", "trans", "vertices", "weights")
    assert (found.costs, found.status, found.verdict) == (
        expected.costs,
        expected.status,
        expected.verdict,
    )
    same(fit, expected, "betas")
    np.testing.assert_array_equal(fit.pose[0], expected.pose)


def test_views_alone_are_what_fit_rgbd_makes_of_them():
    capture = RgbdCapture("views", tuple(person(0)[2]))  # calibrated: not at the origin
    fit = hb.Fit(body(), hb.Depth(capture), QUICK).solve()
    expected = hb.fit_rgbd(capture, body(), settings=QUICK_DEPTH)
    (found,) = fit.results
    same(found, expected, "betas", "pose", "trans", "skin")
    assert (found.costs, found.status, found.verdict) == (
        expected.costs,
        expected.status,
        expected.verdict,
    )
    same(fit, expected, "betas")
    # The same surface, in the frame of the camera rather than the recipe's upright world.
    view = found.prepared_views[0]
    surface = np.asarray(body()(expected.betas, expected.pose[0], expected.trans[0]).vertices)
    np.testing.assert_allclose(fit.vertices(0) @ view.turn.T + view.shift, surface, atol=1e-9)


def filmed(seed, rate_hz, delay, cameras=2):
    """Keypoints of a made person in cameras of the capture's world, from ``delay`` seconds on."""
    betas, pose, trans = person(seed)[0]
    fps = person(seed)[1].fps
    rows = np.arange(round(delay * fps), len(pose), round(fps / rate_hz))
    names = convention_names("body25b")
    shaped = KeypointRig.of(body(), names).shaped(betas, np.zeros((len(names), 3)))
    points = shaped.points(pose[rows], trans[rows])
    rig = ring(cameras, points.mean((0, 1)), 3.5, 180.0)
    rng = np.random.default_rng(seed)
    return detected(points, names, "body25b", rig, rate_hz, rng), rig


def test_keypoints_alone_are_what_fit_cameras_makes_of_them():
    sensor = hb.Keypoints(*filmed(0, 30.0, 0.0))
    fit = hb.Fit(body(), sensor, QUICK).solve()
    (expected,) = hb.fit_cameras(sensor.detections, sensor.calibration, body())
    (found,) = fit.results
    same(found, expected, "betas", "pose", "trans", "keypoint_places")
    same(fit, expected, "betas", "pose", "trans")
    assert fit.verdicts["keypoints"] == expected.verdict
    assert 0.0 < fit.residuals_mm["keypoints"]["median"] < 30.0


def test_keypoints_help_a_capture_of_another_rate_that_began_earlier():
    truth, markers, _ = person(0)
    few = np.full_like(markers.capture, np.nan)
    few[:, ::2] = markers.capture[:, ::2]
    sensor = replace(markers, capture=few, frames=(16, 24, 32, 40))
    seen = hb.Keypoints(*filmed(0, 15.0, 0.4), delay=0.4)

    def error(*sensors):
        fit = hb.Fit(body(), sensors, QUICK).solve()
        assert fit.poses == tuple(f"frame {k}" for k in sensor.frames)
        joints = body()(fit.betas, fit.pose, fit.trans).joints
        return joint_error(joints, truth, sensor.frames)

    nothing = hb.Fit(body(), sensor, QUICK, {"nothing": lambda betas: 0.0 * betas}).solve()
    alone = joint_error(
        body()(nothing.betas, nothing.pose, nothing.trans).joints, truth, sensor.frames
    )
    together = error(sensor, seen)
    assert together < 0.7 * alone
    assert together < 0.8 * error(sensor, replace(seen, delay=0.0))


CASES = {
    "nothing": (lambda markers, views: [], "no sensor"),
    "frames without capture": (
        lambda markers, views: [hb.Depth(views, frames=SHOTS)],
        "0 captures",
    ),
    "frame beyond": (lambda markers, views: [markers, hb.Depth(views, frames=(0, 99))], "frame 99"),
    "frame beyond, alone": (lambda markers, views: replace(markers, frames=(99,)), "frame 99"),
    "frames missing": (lambda markers, views: [markers, hb.Depth(views, frames=(0,))], "1 frames"),
    "no sensor": (lambda markers, views: ["walk.c3d"], "str"),
    "array without layout": (lambda markers, views: replace(markers, layout="auto"), "layout"),
    "columns": (lambda markers, views: replace(markers, capture=markers.capture[:, :5]), "12"),
    "two layouts": (
        lambda markers, views: [markers, replace(markers, layout=hb.load_layout("cmu-41"))],
        "different layouts",
    ),
    "whose frame": (
        lambda markers, views: [markers, markers, hb.Depth(views, frames=SHOTS)],
        "capture=0",
    ),
    "no such capture": (
        lambda markers, views: [markers, hb.Depth(views, frames=SHOTS, capture=1)],
        "capture 1",
    ),
    "keypoints without capture": (
        lambda markers, views: [hb.Keypoints(*filmed(0, 30.0, 0.0)), hb.Depth(views)],
        "without a capture",
    ),
    "whose keypoints": (
        lambda markers, views: [markers, markers, hb.Keypoints(*filmed(0, 30.0, 0.0))],
        "capture=0",
    ),
    "keypoints of another time": (
        lambda markers, views: [markers, hb.Keypoints(*filmed(0, 30.0, 0.0), delay=100.0)],
        "delay",
    ),
    "two sets of keypoints": (
        lambda markers, views: [hb.Keypoints(*filmed(0, 30.0, 0.0))] * 2,
        "2 sets",
    ),
    "two units": (
        lambda markers, views: [hb.Scan(np.zeros((9, 3)), unit=unit) for unit in ("m", "mm")],
        "unit",
    ),
}


def test_keypoints_alone_with_a_term_are_refused():
    terms = {"nothing": lambda betas: 0.0 * betas}
    with pytest.raises(hb.HabitusError, match="without a capture"):
        hb.Fit(body(), hb.Keypoints(*filmed(0, 30.0, 0.0)), QUICK, terms).solve()


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_fitted_is_refused(case):
    sensors, word = CASES[case]
    _, markers, views = person(0)
    with pytest.raises(hb.HabitusError, match=word) as refused:
        hb.Fit(body(), sensors(markers, views), QUICK).solve()
    assert "\n" not in str(refused.value)
