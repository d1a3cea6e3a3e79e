"""Bodies that the compiled kernels do not cover recover their own planted motion, through every
stage.
"""

from dataclasses import replace

import numpy as np
import pytest
from marker_scene import degrees_apart

from habitus.body.prior import shipped_prior
from habitus.fit.markers.energy import Placement
from habitus.fit.markers.marker_sequence import DenseSequence, marker_sequence
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import MoshSettings, SequenceSettings, ShapeWeights
from habitus.fit.markers.shape import shape_stage
from habitus.io.models.bodies import load_body
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers
from habitus.solve.sequence import SequenceOptions

FRAMES = 5
MARKERS = 90
BETAS = 3


@pytest.fixture(scope="module")
def planted():
    """A body with dual quaternion skinning, its shape, motion, and what 90 markers show of it."""
    rng = np.random.default_rng(0)
    body = replace(load_body("default").with_betas(BETAS), skinning="dqbs")
    prior = shipped_prior().for_joints(body.joint_names)
    betas = np.array([0.8, -0.6, 0.5])
    chosen = rng.permutation(body.num_vertices)[:MARKERS]
    placement = Placement(
        chosen, np.full(MARKERS, 0.0095), np.full(MARKERS, 1e-3), np.full(MARKERS, 0.02)
    )
    latent = default_markers(body, betas, chosen, placement.distance)
    markers = LatentMarkers(body, attach(latent, body.rest_vertices(betas), body.faces).triangles)
    wave = np.sin(0.4 * np.arange(FRAMES)[:, None] + rng.uniform(0, 6, len(prior.mean)))
    pose = np.concatenate([np.zeros((FRAMES, 3)), prior.mean + 0.25 * wave], axis=1).reshape(
        FRAMES, -1, 3
    )
    trans = np.linspace(0, 0.1, FRAMES)[:, None] * np.ones(3)
    observed = markers(betas, latent, pose, trans)
    return body, prior, placement, betas, latent, pose, trans, observed


def test_the_shape_stage_recovers_shape_markers_and_poses(planted):
    body, prior, placement, betas, latent, pose, trans, observed = planted
    start = pose + np.radians(4) * np.random.default_rng(1).normal(size=pose.shape)
    weak = MoshSettings(shape=ShapeWeights(betas=1e-3, pose=1e-4), annealing=(40.0, 4.0, 1.0))
    found = shape_stage(body, placement, observed, prior, start, trans + 0.01, weak)
    assert np.abs(found.betas - betas).max() < 0.1
    off = np.linalg.norm(found.latent_markers - latent, axis=1)
    assert off.mean() < 2e-3
    simulated = predict(marked_body(body, found.betas, found.attachment), found.pose, found.trans)
    assert np.linalg.norm(simulated - observed, axis=2).mean() < 2e-3


def test_pose_and_soft_tissue_stages_recover_the_motion(planted):
    body, prior, _, betas, latent, pose, trans, _ = planted
    marked = marked_body(body, betas, attach(latent, body.rest_vertices(betas), body.faces))
    settings = SequenceSettings(pose=1e-3, acceleration=1e-3, soft_tissue=1e-3)
    settings = replace(
        settings, options=SequenceOptions(strides=(1,), sweeps=40, damping=1.0, tolerance=1e-4)
    )
    truth = 0.6 * np.sin(np.arange(FRAMES))[:, None] * np.array([1.0, -0.5, 0.7])
    start = (pose + np.radians(4) * np.random.default_rng(2).normal(size=pose.shape), trans + 0.02)
    still = predict(marked, pose, trans)
    moving = predict(marked, pose, trans, truth)
    assert isinstance(marker_sequence(marked, still, None, None, prior, settings, 0), DenseSequence)
    posed = fit_sequence(marked, still, None, None, prior, *start, settings)
    np.testing.assert_allclose(predict(marked, posed.pose, posed.trans), still, atol=5e-4)
    assert degrees_apart(posed.pose[:, :10], pose[:, :10]) < 2.0
    zero = np.zeros((FRAMES, BETAS))
    soft = fit_sequence(
        marked, moving, None, None, prior, posed.pose, posed.trans, settings, soft_tissue=zero
    )
    np.testing.assert_allclose(soft.soft_tissue, truth, atol=0.1)
    np.testing.assert_allclose(
        predict(marked, soft.pose, soft.trans, soft.soft_tissue), moving, atol=1e-3
    )
