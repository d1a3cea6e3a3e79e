"""Poses of single frames in labelling are the minimum of the marker fit's terms, by steps that only
lower the cost.
"""

import numpy as np
from marker_scene import scene

from habitus.fit.labels.exchanges import exchange_costs, side_by_side
from habitus.fit.markers.energy import sequence_terms
from habitus.fit.markers.marker_sequence import marker_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.solve.minimize import minimize
from habitus.solve.sequence import NOISE_32

FRAMES = 3
SINGLE = SequenceSettings(data=1.0, acceleration=0.0)


def given():
    s = scene(frames=FRAMES, seed=4)
    s.observed[1, 3] = np.nan
    weights = s.rng.uniform(500.0, 900.0, 25)
    pose = s.pose + 0.05 * s.rng.normal(size=s.pose.shape)
    return s, weights, pose, s.trans + 0.01


def test_what_a_frame_costs_is_the_minimum_of_the_terms():
    s, weights, pose, trans = given()
    orders = np.arange(25)[None]
    costs = exchange_costs(s.rig, s.prior, s.observed, pose, trans, weights, orders, sweeps=60)
    every = np.broadcast_to(weights, s.observed.shape[:2])
    for frame in range(FRAMES):
        own = slice(frame, frame + 1)
        terms = sequence_terms(s.marked, s.observed[own], every[own], None, s.prior, SINGLE)
        start = {"pose": pose[own], "trans": trans[own], "soft_tissue": np.zeros((1, 4))}
        used = {name: terms[name] for name in ("data", "pose")}
        found = minimize(used, start, "dogleg", fixed=["soft_tissue"])
        assert found.converged
        np.testing.assert_allclose(costs[0, frame], found.cost, rtol=1e-6)


def test_no_step_raises_a_frames_cost():
    s, weights, pose, trans = given()
    every = np.broadcast_to(weights, s.observed.shape[:2])
    problem = marker_sequence(s.rig, s.observed, every, None, s.prior, SINGLE, 0)
    states = problem.pack(s.rng.normal(size=pose.shape), trans + 0.5, None)
    level = side_by_side(states, problem.pose_end, 10.0)
    before = problem.cost(level.frames, level.states)
    for _ in range(12):
        problem.visit(level, level.frames)
        after = problem.cost(level.frames, level.states)
        assert (after <= before * (1 + NOISE_32)).all()
        before = after
