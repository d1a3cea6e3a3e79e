"""Compile or load every kernel before anything is timed, so that a stage's seconds are those of its
work.
"""

import time

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.causal import CausalSolver
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers
from habitus.solve.sequence.solver import SequenceOptions

FRAMES = 4
MARKERS = 2


def warm_up(body: BodyModel) -> float:
    """Call each kernel of a marker fit once on a few frames of this body; the seconds that took."""
    began = time.perf_counter()
    betas = np.zeros(body.num_betas)
    vertices = np.linspace(0, body.num_vertices - 1, MARKERS).astype(np.int64)
    latent = default_markers(body, betas, vertices, np.full(MARKERS, 0.01))
    rig = marked_body(body, betas, attach(latent, body.rest_vertices(betas), body.faces))
    prior = PosePrior((), np.zeros(0), np.zeros((0, 0))).for_joints(body.joint_names)
    pose = np.zeros((FRAMES, body.num_joints, 3))
    trans = np.zeros((FRAMES, 3))
    soft = np.zeros((FRAMES, body.num_betas))
    scales = np.full(MARKERS, 0.1)
    observed = predict(rig, pose, trans, soft)
    body(betas, pose[0], trans[0])
    brief = SequenceSettings(options=SequenceOptions(strides=(1,), sweeps=1))
    for start in (None, soft):
        fit_sequence(rig, observed, None, scales, prior, pose, trans, brief, soft_tissue=start)
    CausalSolver(rig, prior, pose[0], trans[0], brief, scales).step(observed[0])
    return time.perf_counter() - began
