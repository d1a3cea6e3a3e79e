"""Light and albedo come apart on a body whose albedo is piecewise even; bodies that explain nothing
are not good.
"""

from dataclasses import replace

import numpy as np
import torch

from habitus.fit.points.appearance import ColourShift, Samples, solve_appearance, to_linear
from habitus.fit.points.depth_result import Evidence, ViewEvidence, judge
from habitus.mesh.normals import vertex_normals
from habitus.mesh.shapes import sphere
from habitus.observe.harmonics import harmonics
from habitus.observe.srgb import srgb_bytes


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
    assert judge(replace(GOOD, beta_max=4.0)).level == "doubtful"
    assert judge(replace(GOOD, measurements={"height_m": 2.4})).level == "failed"
    assert judge(replace(GOOD, height_seen=1.95)).level == "failed"
    assert judge(replace(GOOD, limb_apart=(0.1, "left wrist"))).level == "good"
    lost = judge(replace(GOOD, limb_apart=(0.4, "left wrist")))
    reason = lost.reasons[lost.keys.index("limb")]
    assert lost.level == "doubtful" and "left wrist" in reason and "40 cm" in reason
    assert "one view" in judge(replace(GOOD, views=GOOD.views[:1])).keys
