"""The fused kernels against the energy that they implement, written as a dictionary of terms."""

from types import SimpleNamespace

import numpy as np
import pytest
from marker_scene import DoubleSequence, scene

from habitus.fit.markers.energy import sequence_terms
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.sequence_kernels import LevelArrays
from habitus.fit.markers.settings import SequenceSettings
from habitus.solve.minimize import minimize
from habitus.solve.objective import Differentiation, Objective, least_squares_problem
from habitus.solve.sequence import FLOOR, SequenceOptions
from habitus.solve.terms import Unknowns

FRAMES = 6
BETAS = 4
SETTINGS = SequenceSettings(soft_tissue_acceleration=0.7)


@pytest.fixture(scope="module", params=[False, True])
def setting(request):
    """A scene with gaps, weights and mixed scales, its kernels, its terms, and states to look
    at.
    """
    s = scene(frames=FRAMES, seed=7, posedirs=request.param)
    s.observed[2, 4] = np.nan
    weights = s.rng.uniform(0.3, 1.0, s.observed.shape[:2])
    scales = np.where(np.arange(25) % 2, 0.02, np.inf)
    given = (s.observed, weights, scales, s.prior, SETTINGS)
    values = {
        "trans": s.trans + 0.02 * s.rng.normal(size=s.trans.shape),
        "pose": s.pose + 0.1 * s.rng.normal(size=s.pose.shape),
        "soft_tissue": 0.3 * s.rng.normal(size=(FRAMES, BETAS)),
    }
    return s, DoubleSequence(s.rig, *given, BETAS), sequence_terms(s.marked, *given), values


def coupling_cost(problem, states):
    links = problem.chart(np.arange(FRAMES), states)[1]
    return 0.5 * np.sum(links[2:] * np.diff(states, 2, axis=0) ** 2)


def test_the_cost_is_that_of_the_terms(setting):
    _, kernels, terms, values = setting
    states = kernels.pack(values["pose"], values["trans"], values["soft_tissue"])
    objective = Objective.of(terms, None, Unknowns.of(values))
    costs = objective.costs(objective.unknowns.vector)
    own = kernels.cost(np.arange(FRAMES), states)
    assert own.sum() == pytest.approx(
        sum(costs[name] for name in ("data", "pose", "soft_tissue")), rel=1e-12
    )
    assert coupling_cost(kernels, states) == pytest.approx(
        sum(costs[name] for name in costs if name.endswith("acceleration")), rel=1e-12
    )


@pytest.mark.parametrize("frame", range(FRAMES))
def test_a_visit_steps_by_the_terms_gradient_and_matrix(setting, frame):
    _, kernels, terms, values = setting
    objective = Objective.of(terms, None, Unknowns.of(values))
    gradient, matrix = least_squares_problem(objective, Differentiation())(
        objective.unknowns.vector
    )[1]()
    own = np.concatenate(
        [
            np.arange(where.start, where.stop).reshape(FRAMES, -1)[frame]
            for where in objective.unknowns.columns.values()
        ]
    )
    states = kernels.pack(values["pose"], values["trans"], values["soft_tissue"])
    damping = 1e4
    links = np.pad(kernels.chart(np.arange(FRAMES), states)[1], ((0, 2), (0, 0)))
    links[:2] = 0.0
    level = SimpleNamespace(
        frames=np.arange(FRAMES),
        states=states.copy(),
        links=links,
        costs=kernels.cost(np.arange(FRAMES), states),
        damping=np.full(FRAMES, damping),
        moved=np.zeros(FRAMES),
        cost_decrease=np.zeros(FRAMES),
        relaxations=np.ones(FRAMES),
    )
    assert set(vars(level)) == set(LevelArrays._fields)
    kernels.visit(level, np.array([frame]))
    dense = matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
    damped = dense[np.ix_(own, own)] + (damping + FLOOR) * np.eye(len(own))
    expected = -np.linalg.solve(damped, gradient[own])
    step = (level.states - states)[frame, : len(own)]
    assert np.abs(step).max() > 1e-4 and level.cost_decrease[frame] > 0.0
    np.testing.assert_allclose(step, expected, rtol=1e-8, atol=1e-10)


def test_minimising_the_terms_ends_where_the_stage_does(setting):
    s, _, _, _ = setting
    weights = None
    scales = np.where(np.arange(25) % 2, 0.02, np.inf)
    terms = sequence_terms(s.marked, s.observed, weights, scales, s.prior, SETTINGS)
    tight = SequenceSettings(
        soft_tissue_acceleration=0.7,
        options=SequenceOptions(strides=(1,), tolerance=1e-9, cost_tolerance=0.0, sweeps=3000),
    )
    start = np.zeros((FRAMES, BETAS))
    fused = fit_sequence(
        s.rig, s.observed, weights, scales, s.prior, s.pose, s.trans, tight, soft_tissue=start
    )
    plain = minimize(
        terms, {"pose": fused.pose + 1e-3, "trans": fused.trans, "soft_tissue": fused.soft_tissue}
    )
    assert sum(fused.costs.values()) == pytest.approx(plain.cost, rel=1e-5)
    np.testing.assert_allclose(fused.pose, plain.values["pose"], atol=1e-4)
