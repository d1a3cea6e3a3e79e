"""The shape stage's terms: their Jacobians against differences of their residuals, and simulated
markers at rest.
"""

from inspect import signature

import numpy as np
import pytest
import scipy.sparse

from habitus.body.model import BodyModel
from habitus.body.prior import shipped_prior
from habitus.fit.markers.energy import place, shape_terms
from habitus.fit.markers.settings import MoshSettings
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.markers import attach, default_markers
from habitus.residuals.shape_stage import start_place
from habitus.solve.objective import Differentiation, Objective, least_squares_problem
from habitus.solve.terms import Unknowns

FRAMES = 3


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body("default")


@pytest.fixture(scope="module")
def stage(body) -> tuple[dict, dict, LatentMarkers]:
    """Terms, unknowns and markers of a third of a layout, somewhere."""
    rng = np.random.default_rng(0)
    layout = load_layout("cmu-41")
    placement = place(layout.restricted_to(layout.labels[::3]), body)
    betas = 0.3 * rng.normal(size=body.num_betas)
    start = default_markers(body, betas, placement.vertices, placement.distance)
    latent = start + 0.01 * rng.normal(size=start.shape)
    pose = 0.3 * rng.normal(size=(FRAMES, body.num_joints, 3))
    trans = rng.normal(size=(FRAMES, 3))
    weights = rng.uniform(0.5, 1.0, size=(FRAMES, len(latent)))
    weights[1, 2] = 0.0
    prior = shipped_prior().for_joints(body.joint_names)
    markers = LatentMarkers(body, attach(latent, body.rest_vertices(betas), body.faces).triangles)
    observed = rng.normal(size=(FRAMES, len(latent), 3))
    terms = shape_terms(body, markers, placement, observed, weights, prior, MoshSettings(), 2.0)
    return terms, {"betas": betas, "latent_markers": latent, "pose": pose, "trans": trans}, markers


# E_I holds the normals of eq. 1, so its derivative to betas is not exact.
PAIRS = [
    *[("data", name) for name in ("betas", "latent_markers", "pose", "trans")],
    *[("surface", name) for name in ("betas", "latent_markers")],
    ("start", "latent_markers"), ("betas", "betas"), ("pose", "pose"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "unknown"), PAIRS)
def test_jacobians_are_the_derivatives_of_the_residuals(stage, name, unknown):
    terms, values, _ = stage
    function = terms[name].residual
    taken = {key: values[key] for key in signature(function).parameters}
    residual, jacobians = function(**taken)
    jacobian = (jacobians() if callable(jacobians) else jacobians)[unknown]
    direction = np.random.default_rng(1).normal(size=values[unknown].shape)
    moved = [
        function(**{**taken, unknown: values[unknown] + sign * 1e-6 * direction})[0]
        for sign in (1, -1)
    ]
    expected = (moved[0] - moved[1]).ravel() / 2e-6
    assert jacobian.shape == (residual.size, direction.size)
    np.testing.assert_allclose(
        jacobian @ direction.ravel(), expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max()
    )


def test_start_places_without_distance_have_exact_jacobians(body):
    """Then the normals, which are held in the derivative, play no part."""
    ids = np.array([5, 700, 3000])
    count = body.num_betas
    term = start_place(body, ids, np.zeros(3), np.array([0.01, 0.02, 0.03]), 1.0)
    rng = np.random.default_rng(4)
    betas = rng.normal(size=count)
    latent = rng.normal(size=(3, 3))
    expected = [
        term.residual(betas + step, latent)[0] - term.residual(betas, latent)[0]
        for step in np.eye(count)
    ]
    jacobians = term.residual(betas, latent)[1]
    np.testing.assert_allclose(jacobians["betas"], np.reshape(expected, (count, 9)).T, atol=1e-9)


def test_the_gradient_of_the_energy_is_the_slope_of_its_cost(stage):
    terms, values, _ = stage
    problem = Objective.of(terms, None, Unknowns.of(values, fixed=["betas"]))
    evaluate = least_squares_problem(problem, Differentiation())
    x = problem.unknowns.vector
    gradient, matrix = evaluate(x)[1]()
    assert scipy.sparse.issparse(matrix) or matrix.shape == (len(x), len(x))
    rng = np.random.default_rng(2)
    for _ in range(4):
        direction = rng.normal(size=len(x))
        costs = [evaluate(x + sign * 1e-6 * direction)[0] for sign in (1, -1)]
        assert (costs[0] - costs[1]) / 2e-6 == pytest.approx(gradient @ direction, rel=1e-5)


def test_latent_markers_at_rest_are_where_they_are_said_to_be(stage, body):
    _, values, markers = stage
    latent = values["latent_markers"]
    still = (values["betas"], latent, np.zeros((1, body.num_joints, 3)), np.zeros((1, 3)))
    found = markers.jacobian(*still)
    np.testing.assert_allclose(found.markers[0], latent, atol=1e-12)
    np.testing.assert_allclose(markers(*still)[0], latent, atol=1e-12)
    np.testing.assert_allclose(found.by_betas, 0.0, atol=1e-10)
    np.testing.assert_allclose(
        found.by_latent[0], np.broadcast_to(np.eye(3), (len(latent), 3, 3)), atol=1e-12
    )
