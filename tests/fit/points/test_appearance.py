"""Light and albedo come apart on a body whose albedo is piecewise even; bodies that explain nothing
are not good.
"""

from dataclasses import replace

import numpy as np
import torch
from rgbd_scene_small import small_scene

from habitus.fit.points.appearance import (
    ColourShift,
    Samples,
    channel_terms,
    edges_of,
    find_shift,
    moved,
    solve_appearance,
    to_linear,
)
from habitus.fit.points.depth_evidence import Evidence, ViewEvidence
from habitus.fit.points.depth_result import judge
from habitus.fit.points.depth_settings import APPEARANCE
from habitus.fit.points.prepared_views import PreparedView, segment
from habitus.mesh.normals import vertex_normals
from habitus.mesh.shapes import sphere
from habitus.observe.light import harmonics, srgb_bytes
from habitus.render.triangles import Triangles


def test_light_and_albedo_come_apart():
    rng = np.random.default_rng(0)
    ball = sphere()
    vertices = np.asarray(ball.vertices)
    faces = np.asarray(ball.faces)
    albedo = np.where(vertices[:, 1:2] > 0.2, [[0.6, 0.3, 0.2]], [[0.2, 0.4, 0.6]])
    light = np.zeros((9, 3))
    light[0], light[1], light[3] = 1.0 / 0.886227, 0.4, -0.2
    shape = harmonics(torch.from_numpy(vertex_normals(vertices, faces))).numpy()
    seen = np.flatnonzero(vertices[:, 2] > -0.5)
    colour = albedo[seen] * (shape[seen] @ light) + 0.002 * rng.normal(size=(len(seen), 3))
    samples = Samples(seen, colour, shape[seen], np.ones(len(seen)))
    found = solve_appearance(samples, faces, len(vertices), ColourShift(np.zeros(3), None))
    ratio = found.albedo[seen] / albedo[seen]
    assert np.std(np.log(ratio), axis=0).max() < 0.15
    assert np.abs(found.light[1:4] - light[1:4]).max() < 0.12
    assert found.residual < 0.02


def test_the_terms_of_a_channel_have_the_derivatives_that_small_steps_show():
    rng = np.random.default_rng(1)
    ball = sphere()
    count = len(ball.vertices)
    vertex = rng.integers(0, count, 40)
    shape = np.column_stack([np.full(40, 0.9), 0.1 * rng.normal(size=(40, 8))])
    samples = Samples(vertex, rng.uniform(0.2, 0.6, (40, 3)), shape, rng.uniform(0.2, 1.0, 40))
    usual = np.r_[1.1, np.zeros(8)]
    edges = edges_of(np.asarray(ball.faces))
    terms = channel_terms(samples, samples.colour[:, 0], usual, APPEARANCE.light_sd, edges)
    values = {
        "log_albedo": np.log(rng.uniform(0.3, 0.5, count)),
        "light": usual + 0.05 * rng.normal(size=9),
    }
    for term in terms.values():
        found = term(values)
        for name, jacobian in found.jacobians.items():
            step = 1e-6 * rng.normal(size=values[name].shape)
            moved_to = term(values | {name: values[name] + step}).value
            np.testing.assert_allclose(moved_to - found.value, jacobian @ step, atol=1e-8)


def test_outlines_bring_a_moved_colour_camera_back_as_far_as_the_calibration_lets_them():
    body, scene = small_scene()
    triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
    prepared_views = [PreparedView.of(view, segment(view)) for view in scene.capture.views]
    surfaces = [t @ s.turn.T + s.shift for t, s in zip(scene.surfaces, prepared_views, strict=True)]
    true = find_shift(prepared_views, surfaces, triangles)
    off = np.array([0.006, -0.004, 0.0])
    wrong = [replace(s, colour_camera=moved(s.colour_camera, off)) for s in prepared_views]
    found = find_shift(wrong, surfaces, triangles)
    back = (found.shift - true.shift)[:2] / -off[:2]
    assert (back > 0.002).all() and (back < 1.0).all()
    assert found.status in ("converged", "iterations") and found.overlap > 0.7


def test_srgb_and_back():
    every = np.arange(256, dtype=np.uint8)
    assert np.array_equal(srgb_bytes(to_linear(every)), every)


GOOD = Evidence(
    (ViewEvidence("0", 5.0, 0.0, 15.0, 6.0, 0.995, 0.004, 0.93, 0.0, True, False, 9000),) * 2,
    1.5, 0.8, {"height_m": 1.75, "waist_circumference_m": 0.85}, True, True, "background", 1.75,
)  # fmt: skip


def test_the_verdict_is_drawn_from_what_can_be_checked():
    assert judge(GOOD).level == "good"
    worse = {
        "median_mm": 40.0, "explained": 0.8, "outside": 0.2, "overlap": 0.5,
    }  # fmt: skip
    for name, value in worse.items():
        views = (replace(GOOD.views[0], **{name: value}), GOOD.views[1])
        assert judge(replace(GOOD, views=views)).level == "failed", name
    assert judge(replace(GOOD, beta_max=7.0)).level == "doubtful"
    assert judge(replace(GOOD, measurements={"height_m": 2.4})).level == "failed"
    assert judge(replace(GOOD, height_seen=1.95)).level == "failed"
    assert judge(replace(GOOD, limb_apart=(0.1, "left wrist"))).level == "good"
    lost = judge(replace(GOOD, limb_apart=(0.4, "left wrist")))
    reason = lost.reasons[lost.keys.index("limb")]
    assert lost.level == "doubtful" and "left wrist" in reason and "40 cm" in reason
    turned = judge(replace(GOOD, limb_turned=(110.0, "left elbow")))
    assert turned.level == "doubtful" and "turned" in turned.keys
    assert "one view" in judge(replace(GOOD, views=GOOD.views[:1])).keys
