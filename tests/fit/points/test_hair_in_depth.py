"""People whose hair is thicker than a flat cap, before a depth camera."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rgbd_scene_small import QUICK_DEPTH, SCALE, small_scene

from habitus.body.state import BodyState
from habitus.fit.points.colour_views import ColourLevel
from habitus.fit.points.depth import fit_views
from habitus.fit.points.depth_energy import DepthEnergy
from habitus.fit.points.depth_settings import HAIR
from habitus.fit.points.prepared_views import PreparedView, segment
from habitus.fit.points.skin_offsets import SkinField, scalp
from habitus.mesh.normals import vertex_normals
from habitus.results.depth import depth_metrics
from habitus_lab.population.rgbd_people import planted_rest, rgbd_scene


@pytest.fixture(scope="module")
def body():
    return small_scene()[0]


@pytest.mark.parametrize(
    ("thickness", "expected"), [(0.0, 0.0), (0.005, 0.0), (0.02, 0.02), (0.05, 0.05)]
)
def test_the_thickness_of_hair_is_measured(body, thickness, expected):
    pose, trans = np.zeros((1, body.num_joints, 3)), np.zeros((1, 3))
    state = BodyState(np.zeros(body.num_betas), pose, trans)
    surface = np.asarray(body(state.betas, pose[0], trans[0]).vertices)
    normals = vertex_normals(surface, body.faces)
    grown = surface + thickness * scalp(body, HAIR.hairline)[:, None] * normals
    points = grown[normals[:, 2] > 0.0]
    points = points + np.random.default_rng(1).normal(0.0, 0.002, points.shape)
    grid = SimpleNamespace(points=points, person=np.ones(len(points), bool))
    views = (SimpleNamespace(grid=lambda stride: grid),)
    energy = replace(DepthEnergy.of(body, (), QUICK_DEPTH), views=views)
    assert energy.hair(state).max() == pytest.approx(expected, abs=0.004)
    assert not energy.hair(state)[energy.scalp == 0.0].any()
    unmeasured = DepthEnergy.of(body, (), replace(QUICK_DEPTH, measured_hair=None))
    assert not replace(unmeasured, views=views).hair(state).any()


def test_measured_hair_lies_on_the_skin_and_is_no_part_of_it(body):
    bald = SkinField.of(body, QUICK_DEPTH)
    hair = 0.03 * scalp(body, HAIR.hairline)
    field = bald.with_hair(hair)
    numbers = np.random.default_rng(2).normal(size=field.count)
    np.testing.assert_array_equal(field.offset(numbers), bald.offset(numbers))
    np.testing.assert_array_equal(field.layer, np.maximum(bald.layer, hair))
    assert not bald.hair.any() and field.hair.max() == hair.max()


def test_colours_near_points_are_not_used(body):
    _, scene = small_scene()
    (view, _) = scene.capture.views
    prepared = PreparedView.of(view, segment(view))
    surface = scene.surfaces[0] @ prepared.turn.T + prepared.shift
    level = ColourLevel.of(prepared, surface, np.zeros(3), 2)
    top = surface[surface[:, 1].argmax()][None]
    pixel, depth = (each.numpy()[0] for each in level.camera.project(torch.from_numpy(top)))
    radius = 0.1 * float(level.camera.focal_length[0]) / depth
    height, width = level.usable.shape
    rows, columns = np.mgrid[:height, :width]
    away = np.hypot(rows - np.floor(pixel[1]), columns - np.floor(pixel[0]))
    used = level.without(top, 0.1).usable
    np.testing.assert_array_equal(used[away > radius + 1.0], level.usable[away > radius + 1.0])
    assert (away < radius - 1.0).any() and not used[away < radius - 1.0].any()


def test_height_and_head_are_measured_under_the_hair(body):
    """Before, the head grew until it filled 4 cm of hair."""
    rng = np.random.default_rng(5)
    rest = planted_rest(body, rng)
    hair = 0.04 * scalp(body, HAIR.hairline)
    scene = rgbd_scene(body, rest, rng, sensor="azure-kinect", scale=SCALE, hair=hair)
    true = body.measure_rest(rest)
    errors = {}
    for name, settings in (
        ("measured", QUICK_DEPTH),
        ("flat", replace(QUICK_DEPTH, measured_hair=None)),
    ):
        fit = fit_views(scene.capture, body, settings=replace(settings, colour_levels=()))
        assert any("cm thick" in note for note in fit.warnings) == (name == "measured")
        assert (depth_metrics(fit)["hair_mm"] > 20.0) == (name == "measured")
        errors[name] = {key: abs(fit.measurements[key] - true[key]) for key in true}
    assert errors["measured"]["height_m"] < 0.02
    assert errors["measured"]["head_circumference_m"] < 0.025
    for key in ("height_m", "head_circumference_m"):
        assert errors["measured"][key] < 0.5 * errors["flat"][key]
