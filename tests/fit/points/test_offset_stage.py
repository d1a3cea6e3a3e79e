"""Pose and shape under skin that is off the model."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from habitus import load_body
from habitus.body.hands import hand_pose
from habitus.body.jacobians import surface_jacobian
from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.fit.offsets import (
    factored,
    field_precision,
    inverse_product,
    motion_along,
    offset_spread,
)
from habitus.fit.points.correspondences import Topology, find_correspondences
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_evidence import compared
from habitus.fit.points.scan_fitting import OffsetEquations, PreviousFrame, ScanFitter
from habitus.fit.points.scan_stage import ScanStage
from habitus.fit.points.settings import CLOTHES, HairSettings
from habitus.fit.verdict import PARTS, vertex_parts
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointSolver
from habitus.solve.terms import geman_mcclure_weight
from habitus_lab.population.coarse_bodies import coarse_body

STEP = ScanStage(4, points=3000, scale=0.05, noise=0.002)


@pytest.fixture(scope="module")
def fitter() -> ScanFitter:
    body = coarse_body(load_body("default"), 700)
    size = 3 * (body.num_joints - 1)
    prior = PosePrior(body.joint_names[1:], np.zeros(size), 0.04 * np.eye(size))
    return ScanFitter(PointSolver.of(body), Topology.of(body.faces, body.num_vertices), prior)


def sampled(surface: np.ndarray, faces: np.ndarray, count: int, seed: int) -> Cloud:
    rng = np.random.default_rng(seed)
    face = rng.integers(0, len(faces), count)
    share = rng.dirichlet((1.0, 1.0, 1.0), count)
    places, normals = (
        np.einsum("pk,pkc->pc", share, x[faces[face]])
        for x in (surface, vertex_normals(surface, faces))
    )
    return Cloud(places, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def a_state(fitter: ScanFitter, seed: int) -> BodyState:
    rng = np.random.default_rng(seed)
    body = fitter.body
    pose = 0.1 * rng.normal(size=(1, body.num_joints, 3))
    return BodyState(0.5 * rng.normal(size=body.num_betas), pose, 0.02 * rng.normal(size=(1, 3)))


@pytest.mark.parametrize("smoothness", [1, 2])
def test_a_field_has_the_spread_and_the_range_it_is_asked_for(smoothness):
    ball = trimesh.creation.icosphere(3, 0.4)
    vertices = np.asarray(ball.vertices)
    spread = np.full(642, 0.004)
    precision = field_precision(np.asarray(ball.faces), vertices, spread, 0.3, smoothness)
    covariance = np.linalg.inv(precision.toarray())
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.004, rtol=0.1)
    apart = np.linalg.norm(vertices - vertices[0], axis=1)
    alike = covariance[0] / covariance[0, 0]
    assert (
        alike[apart < 0.05].min() > 0.8
        and 0.05 < alike[(apart > 0.28) & (apart < 0.32)].mean() < 0.25
    )


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_the_precision_of_a_field_on_clenched_hands_is_positive_definite(seed):
    body = load_body("female", joints="smplh")
    rng = np.random.default_rng(seed)
    pose = np.zeros((body.num_joints, 3))
    for joint, rotation in hand_pose(body, "fist").items():
        pose[body.joint_names.index(joint)] = 1.3 * rotation + 0.2 * rng.normal(size=3)
    surface = np.asarray(body(np.zeros(body.num_betas), pose).vertices)
    precision = field_precision(body.faces, surface, offset_spread(body), smoothness=2)
    assert factored(precision).U.diagonal().min() > 0.0


def test_the_inverse_product_is_that_of_a_dense_inverse():
    ball = trimesh.creation.icosphere(2, 0.4)
    precision = field_precision(ball.faces, np.asarray(ball.vertices), np.full(162, 0.1), 0.3, 2)
    rows = np.random.default_rng(3).normal(size=(162, 7))
    expected = rows.T @ np.linalg.solve(precision.toarray(), rows)
    np.testing.assert_allclose(inverse_product(factored(precision), rows), expected, rtol=1e-9)


def test_costs_and_derivatives_are_those_of_the_best_offset(fitter):
    """Cost, gradient and matrix with offsets eliminated are those of state and offset together."""
    state = a_state(fitter, 1)
    body = fitter.body
    cloud = sampled(fitter.vertices(a_state(fitter, 2)), body.faces, 300, 0)
    precision = field_precision(body.faces, fitter.vertices(state), offset_spread(body))
    mean = 0.001 * np.ones(body.num_vertices)
    scan = OffsetEquations.of(fitter, state, cloud, precision, mean, STEP)
    rows, weight, missing = point_rows(fitter, scan.model, cloud, mean)
    lumped = rows.T @ (weight[:, None] * rows)

    def energy(displaced: np.ndarray) -> float:  # least over all offsets
        pull = rows.T @ (weight * missing) - lumped @ displaced
        offset = np.linalg.solve(lumped + precision.toarray(), pull)
        residual = rows @ (displaced + offset) - missing
        return 0.5 * weight @ residual**2 + 0.5 * offset @ (precision @ offset)

    slopes = surface_jacobian(body, state.betas, state.pose[0], state.trans[0])
    along = motion_along(vertex_normals(scan.model, body.faces), slopes)
    change = 0.01 * np.random.default_rng(4).normal(size=along.shape[1])
    gradient, matrix = scan.equations(state.betas, state.pose[0], state.trans[0])
    here = scan.cost(scan.model)
    np.testing.assert_allclose(here, energy(np.zeros(body.num_vertices)), rtol=1e-9)
    expected = here + gradient @ change + 0.5 * change @ matrix @ change
    np.testing.assert_allclose(expected, energy(along @ change), rtol=1e-8)
    moved = scan.model + (along @ change)[:, None] * scan.normal
    np.testing.assert_allclose(scan.cost(moved), energy(along @ change), rtol=1e-9)


def point_rows(
    fitter: ScanFitter, model: np.ndarray, cloud: Cloud, mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points by vertices, their weights, and what is missing to their planes, one by one."""
    surface = model + mean[:, None] * vertex_normals(model, fitter.topology.faces)
    found = find_correspondences(fitter.topology, surface, cloud.points, cloud.normals)
    distance = np.linalg.norm(cloud.points - found.closest, axis=1)
    noise = STEP.noise_of(len(distance))
    agree = found.cosine > 0.5
    scale = max(STEP.scale, fitter.settings.scale_ratio * np.median(distance[agree]))
    weight = geman_mcclure_weight(distance, scale) * agree / noise**2
    rows = np.zeros((len(weight), len(model)))
    np.put_along_axis(rows, fitter.topology.faces[found.face], found.barycentric, axis=1)
    return rows, weight, ((cloud.points - rows @ model) * found.normal).sum(1) - rows @ mean


def test_skin_that_swells_moves_the_model_less_than_without_an_offset(fitter):
    body = fitter.body
    truth = a_state(fitter, 5)
    model = fitter.vertices(truth)
    swell = 0.004 * np.sin(model @ (9.0, 7.0, 8.0))
    clouds = [
        sampled(model + swell[:, None] * vertex_normals(model, body.faces), body.faces, 3000, 6)
    ]
    begin = replace(truth, trans=truth.trans + 0.005)
    fit = fitter.fit_with_offsets(begin, clouds, (STEP,))
    (surface,) = fit.surfaces
    without = fitter.fit(begin, clouds, (replace(STEP, noise=0.005),))
    error = [
        np.linalg.norm(fitter.vertices(one) - model, axis=1).mean() for one in (fit.state, without)
    ]
    assert error[0] < 0.7 * error[1]
    true = model + swell[:, None] * vertex_normals(model, body.faces)
    assert np.linalg.norm(surface - true, axis=1).mean() < 0.9 * error[0]


def test_several_scans_share_their_shape_and_a_true_start_stays(fitter):
    one = a_state(fitter, 7)
    other = a_state(fitter, 8)
    truth = BodyState(
        one.betas, np.concatenate([one.pose, other.pose]), np.concatenate([one.trans, other.trans])
    )
    clouds = [sampled(fitter.vertices(truth, k), fitter.body.faces, 3000, k) for k in range(2)]
    loose = replace(STEP, pose=1e-6, shape=1e-6)
    fit = fitter.fit_with_offsets(truth, clouds, (loose,))
    for k, surface in enumerate(fit.surfaces):
        true = fitter.vertices(truth, k)
        for found in (fitter.vertices(fit.state, k), surface):
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
    coupled = replace(fitter, previous=PreviousFrame(true.betas, true.pose[0], swell))
    off = []
    for one in (fitter, coupled):
        (found,) = one.fit_with_offsets(start, [cloud], (STEP,)).surfaces
        off.append(np.linalg.norm(found - surface, axis=1).mean())
    assert off[1] < 0.6 * off[0]


def test_few_points_weigh_as_much_as_many_down_to_the_least_noise(fitter):
    stage = fitter.settings.last_stages[0]
    assert stage.noise_of(stage.points) == stage.noise == stage.noise_of(10 * stage.points)
    half = stage.noise_of(stage.points // 2)
    weights = stage.points // 2 / half**2, stage.points / stage.noise**2
    np.testing.assert_allclose(*weights, rtol=1e-12)
    assert stage.noise_of(100) == stage.least_noise
    assert STEP.noise_of(100) == STEP.noise


def test_every_stage_has_a_field_of_its_own_smoothness(fitter):
    truth = a_state(fitter, 5)
    model = fitter.vertices(truth)
    swell = 0.004 * np.sin(40.0 * model[:, 1])[:, None]
    skin = model + swell * vertex_normals(model, fitter.body.faces)
    cloud = sampled(skin, fitter.body.faces, 2000, 6)
    start = replace(truth, trans=truth.trans + 0.005)
    smooth = replace(STEP, smoothness=2, steps=12)
    rough, alone, last = (
        fitter.fit_with_offsets(start, [cloud], stages).costs["offset"]
        for stages in ((replace(STEP, steps=12),), (smooth,), (STEP, smooth))
    )
    assert abs(last - alone) < 0.2 * abs(rough - alone)


@pytest.mark.parametrize(
    ("thickness", "expected"),
    [(0.0, 0.0), (0.006, 0.0), (0.013, 0.013), (0.03, 0.03), (0.05, 0.05)],
)
def test_the_thickness_of_hair_is_measured(fitter, thickness, expected):
    state = a_state(fitter, 2)
    prior = fitter.offset_prior(state, [with_hair(fitter, state, thickness)])
    measured = prior.mean[fitter.scalp > 0.99]
    np.testing.assert_allclose(measured, expected, rtol=0.12)
    assert not prior.mean[fitter.scalp == 0.0].any()
    spread = offset_spread(fitter.body, fitter.settings.offsets)
    np.testing.assert_allclose(prior.spread, np.hypot(spread, prior.mean))


def test_hair_that_the_clothes_describe_is_not_measured(fitter):
    state = a_state(fitter, 2)
    cloud = with_hair(fitter, state, 0.03)
    for name in ("tight", "loose"):
        dressed = replace(fitter, settings=replace(fitter.settings, clothes=CLOTHES[name]))
        assert dressed.offset_prior(state, [cloud]).mean.max() < 0.004


def test_the_head_does_not_grow_into_the_hair(fitter):
    """The model's face stays where it is, and the surface is that of the hair."""
    truth = a_state(fitter, 2)
    cloud = with_hair(fitter, truth, 0.04)
    hairless = replace(fitter, settings=replace(fitter.settings, hair=HairSettings(hairline=9.0)))
    assert not hairless.scalp.any()
    whole = replace(STEP, betas=fitter.body.num_betas)
    names = fitter.body.joint_names
    face = (fitter.body.strongest_joint == names.index("head")) & (fitter.scalp == 0.0)
    error = {}
    for name, one in (("hair", fitter), ("none", hairless)):
        light = replace(whole, noise=0.005, scalp_weight=one.settings.hair.weight)
        fit = one.fit_with_offsets(one.fit(truth, [cloud], (light,)), [cloud], (whole,))
        apart = fitter.vertices(fit.state) - fitter.vertices(truth)
        error[name] = np.linalg.norm(apart[face], axis=1).mean()
    assert error["hair"] < 0.003
    assert error["hair"] < 0.5 * error["none"]


def with_hair(fitter: ScanFitter, state: BodyState, thickness: float) -> Cloud:
    """A scan of a person with hair."""
    model = fitter.vertices(state)
    faces = fitter.body.faces
    hair = thickness * fitter.scalp[:, None] * vertex_normals(model, faces)
    return sampled(model + hair, faces, 9000, 3)


@pytest.mark.parametrize(
    ("joint", "off", "lost"),
    [
        ("left_hip", 0.012, False),
        ("left_hip", 0.025, True),
        ("left_hand", 0.012, True),
        ("head", 0.012, True),
    ],
)
def test_folds_of_the_body_may_be_further_off_than_hands_and_head(fitter, joint, off, lost):
    state = a_state(fitter, 3)
    model = fitter.vertices(state)
    faces = fitter.body.faces
    here = fitter.body.strongest_joint == fitter.body.joint_names.index(joint)
    moved = model + off * here[:, None] * vertex_normals(model, faces)
    cloud = sampled(moved, faces, 9000, 3)
    found = compared(fitter, cloud, model, model)
    assert (found["lost"] > 0.002) == lost
    assert not lost or found["lost_part"] == PARTS[vertex_parts(fitter.body)[here][0]]
