"""The energy of the depth stages: its gradient is what small steps show, and steps lead downhill to
what is planted.
"""

import numpy as np
from synthetic import synthetic_body

from habitus.fit.points.depth_energy import NOTHING, Priors, costs_of, gauss_newton_step, merged
from habitus.fit.points.settings import RgbdSettings
from habitus.fit.points.state import State
from habitus.residuals.points import PointObservations, PointSolver, points_on_surface


def scene(views=2, count=400):
    """A planted state, points on its surfaces as targets, and a state beside it."""
    body = synthetic_body("smpl", 120)
    rng = np.random.default_rng(2)
    shape = (views, body.num_joints, 3)
    truth = State(
        0.5 * rng.normal(size=body.num_betas),
        0.1 * rng.normal(size=shape),
        rng.normal(size=(views, 3)),
    )
    face = rng.integers(0, body.num_faces, count)
    share = rng.dirichlet((1, 1, 1), count)
    terms = []
    for k in range(views):
        vertices = body(truth.betas, truth.pose[k], truth.trans[k]).vertices
        target = points_on_surface(vertices, body.faces, face, share)
        matches = PointObservations.to_planes(
            face, share, target, np.tile([0.0, 0.0, 1.0], (count, 1)), np.ones(count), 1.0
        )
        terms.append({"depth": matches, "floor": NOTHING})
    start = State(
        np.zeros(body.num_betas), truth.pose + 0.05 * rng.normal(size=shape), truth.trans + 0.1
    )
    return body, PointSolver.of(body), truth, start, terms


def test_steps_lead_to_the_planted_state():
    body, solver, truth, state, terms = scene()
    priors = Priors.of(body, truth, RgbdSettings(shape=1e-9, pose=1e-9))
    costs = []
    for _ in range(8):
        state, cost = gauss_newton_step(solver, state, terms, priors, "all")
        costs.append(cost)
    assert costs[-1] < 1e-8 * costs[0]
    for k in range(2):
        found, true = (body(s.betas, s.pose[k], s.trans[k]).vertices for s in (state, truth))
        np.testing.assert_allclose(found, true, atol=1e-4)


def test_only_what_moves_moves():
    body, solver, truth, start, terms = scene()
    priors = Priors.of(body, truth, RgbdSettings())
    placed, _ = gauss_newton_step(solver, start, terms, priors, "place")
    assert np.array_equal(placed.betas, start.betas) and np.array_equal(
        placed.pose[:, 1:], start.pose[:, 1:]
    )
    assert not np.allclose(placed.trans, start.trans) and not np.allclose(
        placed.pose[:, 0], start.pose[:, 0]
    )
    posed, _ = gauss_newton_step(solver, start, terms, priors, "pose")
    assert np.array_equal(posed.betas, start.betas) and not np.allclose(
        posed.pose[:, 1:], start.pose[:, 1:]
    )


def test_a_step_is_never_a_leap():
    body, solver, truth, start, terms = scene()
    far = State(start.betas, start.pose, start.trans + 10.0)
    moved, _ = gauss_newton_step(solver, far, terms, Priors.of(body, truth, RgbdSettings()), "all")
    assert np.abs(moved.trans - far.trans).max() <= 0.5 + 1e-12


def test_terms_add_up():
    body, solver, truth, start, terms = scene()
    priors = Priors.of(body, truth, RgbdSettings())
    apart = sum(costs_of(solver, start, terms).values()) + sum(priors.costs(start).values())
    _, whole = gauss_newton_step(solver, start, terms, priors, "all")
    np.testing.assert_allclose(apart, whole)
    assert merged({"a": NOTHING}) is NOTHING
