"""The shape stage's terms: derivatives against finite differences, the arrow form against the dense one."""

import numpy as np
import pytest

from habitus.body.model import BodyModel
from habitus.fit.mosh.equations import arrow_equations
from habitus.fit.mosh.recipe import place
from habitus.fit.mosh.settings import MoshSettings
from habitus.fit.mosh.shape import _blocks, _Stage, simulate
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.io.models.priors import load_pose_prior
from habitus.observe.markers import attach
from habitus.observe.rest import RestShape
from habitus.residuals.blocks import costs_by_name, normal_equations
from habitus.residuals.shape_stage import Columns

FRAMES = 3


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body("default")


@pytest.fixture(scope="module")
def stage(body) -> tuple[_Stage, np.ndarray]:
    rng = np.random.default_rng(0)
    layout = load_layout("cmu-41")
    placement, rest = place(layout.restricted_to(layout.labels[::3]), body), RestShape(body)
    betas = 0.3 * rng.normal(size=rest.num_betas)
    latent = rest.default_markers(betas, placement.vertices, placement.distance)[0] + 0.01 * rng.normal(
        size=(len(placement.vertices), 3)
    )
    columns = Columns(rest.num_betas, len(latent), FRAMES, body.num_joints)
    pose, trans = 0.3 * rng.normal(size=(FRAMES, body.num_joints, 3)), rng.normal(size=(FRAMES, 3))
    weights = rng.uniform(0.5, 1.0, size=(FRAMES, len(latent)))
    weights[1, 2] = 0.0
    prior = load_pose_prior().for_joints(body.joint_names)
    attachment = attach(latent, rest.vertices(betas), rest.faces)
    observed = rng.normal(size=(FRAMES, len(latent), 3))
    settings = MoshSettings()
    made = _Stage(body, rest, placement, observed, weights, prior, settings, attachment, 2.0, columns)
    return made, columns.pack(betas, latent, pose, trans)


def test_gradient_is_the_slope_of_the_cost(stage):
    made, x = stage
    _, gradient, _ = normal_equations(_blocks(made, x), len(x))
    rng = np.random.default_rng(1)
    for _ in range(6):
        direction = rng.normal(size=len(x))
        direction[made.columns.betas] *= 0.0  # E_I holds the normals of eq. 1: its slope to betas is tested below
        step = 1e-6 * direction
        costs = [sum(costs_by_name(_blocks(made, x + sign * step)).values()) for sign in (1, -1)]
        assert (costs[0] - costs[1]) / 2e-6 == pytest.approx(gradient @ direction, rel=1e-5)


@pytest.mark.parametrize("term", ["data", "surface", "betas", "pose"])
def test_slope_to_betas(stage, term):
    made, x = stage
    blocks = [block for block in _blocks(made, x) if block.name == term]
    _, gradient, _ = normal_equations(blocks, len(x))
    direction = np.zeros(len(x))
    direction[made.columns.betas] = np.random.default_rng(2).normal(size=made.columns.num_betas)
    costs = [costs_by_name(_blocks(made, x + sign * 1e-6 * direction))[term] for sign in (1, -1)]
    assert (costs[0] - costs[1]) / 2e-6 == pytest.approx(gradient @ direction, rel=1e-5, abs=1e-6)


def test_arrow_and_dense_normal_equations_agree(stage):
    made, x = stage
    columns, blocks = made.columns, _blocks(made, x)
    cost, gradient, matrix = normal_equations(blocks, len(x))
    shared = columns.latent_markers.stop
    cost_a, gradient_a, arrow = arrow_equations(blocks, shared, columns.num_frames, columns.frame_size)
    assert cost_a == pytest.approx(cost)
    np.testing.assert_allclose(gradient_a, gradient)
    np.testing.assert_allclose(arrow.dense(), matrix, atol=1e-9 * np.abs(matrix).max())


def test_latent_markers_at_rest_are_where_they_are_said_to_be(stage, body):
    made, x = stage
    betas, latent, _, _ = made.columns.unpack(x)
    still = np.zeros((1, body.num_joints, 3))
    rest = made.rest.vertices(betas)
    simulated = simulate(body, betas, latent, made.attachment.triangles, rest, still, np.zeros((1, 3)))
    np.testing.assert_allclose(simulated.markers[0], latent, atol=1e-12)
    np.testing.assert_allclose(simulated.by_betas, 0.0, atol=1e-10)
    np.testing.assert_allclose(simulated.by_latent[0], np.broadcast_to(np.eye(3), (len(latent), 3, 3)), atol=1e-12)
