"""Pose and shape under skin that is off the model."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from habitus import load_body
from habitus.body.jacobians import surface_jacobian
from habitus.body.prior import PosePrior
from habitus.fit.points.correspondences import Topology
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_fitting import (
    FrameBefore,
    ModelFitter,
    ModelStep,
    _pull,
    field_precision,
    fit_with_offsets,
    offset_spread,
)
from habitus.fit.points.state import ModelState
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointSolver
from habitus_lab.population.coarse_bodies import coarse_body

STEP = ModelStep(4, 3000, 0.05, 0.002, 0.0, 1000)


@pytest.fixture(scope="module")
def fitter() -> ModelFitter:
    body = coarse_body(load_body("default"), 700)
    size = 3 * (body.num_joints - 1)
    prior = PosePrior(body.joint_names[1:], np.zeros(size), 0.04 * np.eye(size))
    return ModelFitter(PointSolver.of(body), Topology.of(body.faces, body.num_vertices), prior)


def sampled(surface: np.ndarray, faces: np.ndarray, count: int, seed: int) -> Cloud:
    rng = np.random.default_rng(seed)
    face = rng.integers(0, len(faces), count)
    share = rng.dirichlet((1.0, 1.0, 1.0), count)
    places, normals = (
        np.einsum("pk,pkc->pc", share, x[faces[face]])
        for x in (surface, vertex_normals(surface, faces))
    )
    return Cloud(places, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def a_state(fitter: ModelFitter, seed: int) -> ModelState:
    rng = np.random.default_rng(seed)
    body = fitter.body
    pose = 0.1 * rng.normal(size=(1, body.num_joints, 3))
    return ModelState(0.5 * rng.normal(size=body.num_betas), pose, 0.02 * rng.normal(size=(1, 3)))


def test_a_field_has_the_spread_and_the_range_it_is_asked_for():
    ball = trimesh.creation.icosphere(3, 0.4)
    vertices = np.asarray(ball.vertices)
    precision = field_precision(
        Topology.of(np.asarray(ball.faces), len(vertices)), vertices, np.full(642, 0.004), 0.3
    )
    covariance = np.linalg.inv(precision.toarray())
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.004, rtol=0.1)
    apart = np.linalg.norm(vertices - vertices[0], axis=1)
    alike = covariance[0] / covariance[0, 0]
    assert (
        alike[apart < 0.05].min() > 0.8
        and 0.05 < alike[(apart > 0.28) & (apart < 0.32)].mean() < 0.25
    )


def test_a_step_is_that_of_state_and_offset_together(fitter):
    state = a_state(fitter, 1)
    body = fitter.body
    cloud = sampled(fitter.vertices(a_state(fitter, 2)), body.faces, 300, 0)
    held = field_precision(fitter.topology, fitter.vertices(state), offset_spread(body))
    pull = _pull(
        fitter, state, cloud, held, np.zeros(body.num_vertices), np.zeros(body.num_vertices), STEP
    )
    slopes = surface_jacobian(body, state.betas, state.pose[0], state.trans[0])
    model = np.asarray(slopes.surface.vertices)
    count = body.num_vertices
    normal = vertex_normals(model, body.faces)
    still = np.broadcast_to(np.eye(3), (count, 3, 3))
    moves = [x.reshape(count, 3, -1) for x in (slopes.vertices_betas, still, slopes.vertices_pose)]
    along = np.einsum("vc,vcn->vn", normal, np.concatenate(moves, 2))
    change = 0.01 * np.random.default_rng(4).normal(size=along.shape[1])
    lumped, wanted = _lumped(fitter, model, cloud)

    def energy(change: np.ndarray) -> float:  # least over all offsets
        offset = np.linalg.solve(lumped + held.toarray(), wanted - lumped @ along @ change)
        there = offset + along @ change
        return 0.5 * there @ lumped @ there - wanted @ there + 0.5 * offset @ (held @ offset)

    expected = pull.gradient @ change + 0.5 * change @ pull.matrix @ change
    assert energy(change) - energy(0 * change) == pytest.approx(expected, rel=1e-6)
    offset = np.linalg.solve(lumped + held.toarray(), wanted - lumped @ along @ change)
    np.testing.assert_allclose(pull.offset - pull.slope @ change, offset, atol=1e-9)


def _lumped(fitter: ModelFitter, model: np.ndarray, cloud: Cloud) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and right-hand side of offsets alone, from points and planes one by one."""
    from habitus.fit.points.correspondences import nearest
    from habitus.residuals.robust import geman_mcclure_weight

    found = nearest(fitter.topology, model, cloud.points, cloud.normals)
    apart = np.linalg.norm(cloud.points - found.place, axis=1)
    weight = geman_mcclure_weight(apart, STEP.reach) * (found.cosine > 0.5) / STEP.noise**2
    rows = np.zeros((len(weight), len(model)))
    np.put_along_axis(rows, fitter.topology.faces[found.face], found.barycentric, axis=1)
    missing = ((cloud.points - rows @ model) * found.normal).sum(1)
    return rows.T @ (weight[:, None] * rows), rows.T @ (weight * missing)


def test_skin_that_swells_moves_the_model_less_than_without_an_offset(fitter):
    body = fitter.body
    truth = a_state(fitter, 5)
    model = fitter.vertices(truth)
    swell = 0.004 * np.sin(model @ (9.0, 7.0, 8.0))
    clouds = [
        sampled(model + swell[:, None] * vertex_normals(model, body.faces), body.faces, 3000, 6)
    ]
    begin = replace(truth, trans=truth.trans + 0.005)
    state, (surface,) = fit_with_offsets(fitter, begin, clouds, (STEP,))
    without = fitter.fit(begin, clouds, (replace(STEP, noise=0.005),))
    error = [
        np.linalg.norm(fitter.vertices(one) - model, axis=1).mean() for one in (state, without)
    ]
    assert error[0] < 0.7 * error[1]
    true = model + swell[:, None] * vertex_normals(model, body.faces)
    assert np.linalg.norm(surface - true, axis=1).mean() < 0.9 * error[0]


def test_several_scans_share_their_shape_and_a_true_start_stays(fitter):
    one = a_state(fitter, 7)
    other = a_state(fitter, 8)
    truth = ModelState(
        one.betas, np.concatenate([one.pose, other.pose]), np.concatenate([one.trans, other.trans])
    )
    clouds = [sampled(fitter.vertices(truth, k), fitter.body.faces, 3000, k) for k in range(2)]
    loose = replace(STEP, pose=1e-6, shape=1e-6)
    state, surfaces = fit_with_offsets(fitter, truth, clouds, (loose,))
    for k, surface in enumerate(surfaces):
        true = fitter.vertices(truth, k)
        for found in (fitter.vertices(state, k), surface):
            assert np.linalg.norm(found - true, axis=1).mean() < 5e-4


def test_a_frame_gains_by_the_one_before(fitter):
    """Few points tell little: what the frame before knew of shape, pose and skin brings the surface
    nearer.
    """
    true = a_state(fitter, 8)
    body = fitter.body
    swell = 0.004 * np.sin(40.0 * body.rest_vertices(true.betas)[:, 1])
    surface = fitter.vertices(true) + swell[:, None] * vertex_normals(
        fitter.vertices(true), body.faces
    )
    cloud = sampled(surface, body.faces, 150, 9)
    start = replace(true, betas=np.zeros(body.num_betas))
    coupled = replace(fitter, before=FrameBefore(true.betas, true.pose[0], swell))
    off = []
    for one in (fitter, coupled):
        _, (found,) = fit_with_offsets(one, start, [cloud], (STEP,))
        off.append(np.linalg.norm(found - surface, axis=1).mean())
    assert off[1] < 0.6 * off[0]
