"""Laws of `Term`: robust losses, fixed unknowns, dataclasses, NumPy in kind, arrow form, and no
needless torch.
"""

import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import torch

from habitus.errors import HabitusError
from habitus.solve.arrow_terms import arrow_problem
from habitus.solve.minimize import METHODS, minimize
from habitus.solve.objective import Differentiation, Objective, least_squares_problem
from habitus.solve.terms import GemanMcClure, Term, Unknowns, geman_mcclure_weight


def points(kind, count=30, outliers=5, seed=0):
    """Points about a centre, some far off: the term of their distances, with its Jacobian for
    NumPy.
    """
    rng = np.random.default_rng(seed)
    seen = np.array([1.0, -2.0, 0.5]) + 0.01 * rng.normal(size=(count, 3))
    seen[:outliers] += (3.0, 0.0, 1.0)

    def residual(centre):
        if kind == "torch":
            return centre - torch.tensor(seen)
        return centre - seen, lambda: {"centre": np.tile(np.eye(3), (count, 1))}

    start = {"centre": torch.zeros(3).double() if kind == "torch" else np.zeros(3)}
    return residual, start, seen


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_geman_mcclure_leaves_outliers_out_and_costs_what_it_says(method, kind):
    residual, start, seen = points(kind)
    scale = np.where(np.arange(30) % 2, 0.2, 0.3)
    start["centre"] = start["centre"] + 0.8 * (
        torch.tensor(seen[9]) if kind == "torch" else seen[9]
    )
    result = minimize({"data": Term(residual, 2.0, GemanMcClure(scale))}, start, method)
    centre = np.asarray(result.values["centre"])
    np.testing.assert_allclose(centre, seen[5:].mean(0), atol=0.02)
    squared = np.sum((centre - seen) ** 2, axis=1)
    assert result.cost == pytest.approx(
        np.sum(scale**2 * squared / (scale**2 + squared)), rel=1e-12
    )

    def cost(x):
        squared = np.sum((x - seen) ** 2, axis=1)
        return np.sum(scale**2 * squared / (scale**2 + squared))

    peer = scipy.optimize.minimize(cost, centre + 0.01, method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(centre, peer.x, atol=1e-5)


def test_the_gradient_is_the_slope_of_the_robust_cost():
    residual, start, _ = points("numpy")
    problem = Objective.of(
        {"data": Term(residual, 3.0, GemanMcClure(0.7))}, None, Unknowns.of(start)
    )
    evaluate = least_squares_problem(problem, Differentiation())
    x = np.array([0.3, -1.0, 0.2])
    gradient, matrix = evaluate(x)[1]()
    for k, unit in enumerate(np.eye(3)):
        change = (evaluate(x + 1e-6 * unit)[0] - evaluate(x - 1e-6 * unit)[0]) / 2e-6
        assert gradient[k] == pytest.approx(change, rel=1e-6)
    assert (np.linalg.eigvalsh(matrix) > 0).all()


def test_an_infinite_scale_is_the_square():
    residual, start, seen = points("numpy")
    result = minimize(Term(residual, robust=GemanMcClure(np.inf)), start)
    np.testing.assert_allclose(result.values["centre"], seen.mean(0), atol=1e-9)


def line(fixed_too):
    def residual(slope, offset):
        x = np.arange(4.0)
        made = {"slope": x[:, None], "offset": np.ones((4, 1))}
        return slope * x + offset - (2.0 * x + 1.0), made if fixed_too else {"slope": x[:, None]}

    return residual


@pytest.mark.parametrize("fixed_too", [True, False])
def test_fixed_values_stay_and_terms_take_them(fixed_too):
    start = {"slope": np.zeros(1), "offset": np.array([1.0], dtype=np.float32)}
    result = minimize(line(fixed_too), start, fixed=["offset"])
    np.testing.assert_allclose(result.values["slope"], 2.0)
    assert (
        result.values["offset"] == 1.0
        and result.values["offset"].dtype == np.float32
        and result.x.shape == (1,)
    )
    with pytest.raises(HabitusError, match="'shift' cannot be fixed"):
        minimize(line(True), start, fixed=["shift"])


@dataclass(frozen=True)
class State:
    slope: np.ndarray
    offset: np.ndarray | None = None
    unused: np.ndarray | None = None


def test_a_dataclass_goes_in_and_comes_out():
    result = minimize(line(True), State(np.zeros(1), np.zeros(1)))
    assert (
        isinstance(result.state, State)
        and result.state.unused is None
        and "unused" not in result.values
    )
    np.testing.assert_allclose([result.state.slope[0], result.state.offset[0]], [2.0, 1.0])


@pytest.mark.parametrize("sparse", [False, True])
def test_a_jacobian_of_the_wrong_axes_is_refused(sparse):
    by_x = np.arange(6.0).reshape(3, 2)

    def term(jacobian):
        return {"line": lambda x: (by_x @ x - 1.0, {"x": jacobian})}

    given = scipy.sparse.csr_array(by_x) if sparse else by_x
    minimize(term(given), {"x": np.zeros(2)})
    with pytest.raises(HabitusError, match=r"has shape \(2, 3\); expected \(3, 2\)"):
        minimize(term(given.T), {"x": np.zeros(2)})


def test_a_term_has_a_weight_which_weights_replace():
    both = {"a": Term(lambda x: x - 1.0, weight=3.0), "b": lambda x: x - 2.0}
    assert float(minimize(both, {"x": torch.zeros(1)}).values["x"]) == pytest.approx(1.25, abs=1e-6)
    equal = minimize(both, {"x": torch.zeros(1)}, weights={"a": 1.0})
    assert float(equal.values["x"]) == pytest.approx(1.5, abs=1e-6)
    assert list(minimize(Term(lambda x: x, name="stay"), {"x": torch.ones(1)}).costs) == ["stay"]


def test_numpy_values_of_a_term_without_jacobian_are_differentiated_by_torch():
    result = minimize({"root": lambda x: x**2 - 2.0}, {"x": np.ones(2, dtype=np.float32)})
    assert isinstance(result.values["x"], np.ndarray) and result.values["x"].dtype == np.float32
    np.testing.assert_allclose(result.values["x"], np.sqrt(2.0), rtol=1e-6)


def test_without_torch_a_solve_of_arrays_needs_none_and_says_where_it_does():
    code = """
import sys
sys.modules["torch"] = None
import numpy as np
from habitus.errors import HabitusError
from habitus.solve.minimize import minimize
found = minimize(lambda x: (x - 2.0, {"x": np.eye(3)}), {"x": np.zeros(3)})
assert np.allclose(found.values["x"], 2.0)
try:
    minimize(lambda x: x - 2.0, {"x": np.zeros(3)})
except HabitusError as error:
    assert "habitus[torch]" in str(error) and "Jacobians" in str(error)
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    told = (
        "import sys, habitus.solve.minimize, habitus.solve.terms; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", told], check=True)


COUNT = 4
WIDTH = 3
SHARED = 5
ROWS = 7


def arrow_terms(form, robust=None):
    """Random linear terms of 5 shared unknowns and 4 blocks of 2 + 1."""
    rng = np.random.default_rng(0)
    own = rng.normal(size=(COUNT, ROWS, 2))
    other = rng.normal(size=(COUNT, ROWS, 1))
    shared = rng.normal(size=(COUNT * ROWS, SHARED)) * (rng.random((COUNT * ROWS, SHARED)) < 0.5)
    goal = rng.normal(size=(COUNT, ROWS))
    along = np.arange(COUNT)
    ends = np.arange(COUNT + 1)
    blocks = {
        name: scipy.sparse.bsr_array((table, along, ends))
        for name, table in (("pose", own), ("trans", other))
    }
    if form == "dense":
        blocks = {name: block.toarray() for name, block in blocks.items()}
    common = shared if form == "dense" else scipy.sparse.csr_array(shared)

    def data(pose, betas, trans):
        found = (own @ pose[..., None] + other @ trans[..., None])[..., 0] + (
            shared @ betas
        ).reshape(COUNT, ROWS)
        return found - goal, {"betas": common, **blocks}

    return {
        "data": Term(data, 2.0, robust),
        "betas": Term(lambda betas: (betas, {"betas": scipy.sparse.eye_array(SHARED)}), 0.1),
        "trans": Term(lambda trans: (trans - 1.0, {"trans": np.eye(COUNT)})),
    }


@pytest.mark.parametrize("form", ["dense", "sparse"])
@pytest.mark.parametrize("robust", [None, GemanMcClure(1.5)])
def test_arrow_and_dense_normal_equations_agree(form, robust):
    start = {"pose": np.zeros((COUNT, 2)), "betas": np.ones(SHARED), "trans": np.zeros((COUNT, 1))}
    problem = Objective.of(arrow_terms(form, robust), None, Unknowns.of(start))
    x = np.random.default_rng(1).normal(size=len(problem.unknowns.vector))
    cost, derivatives = arrow_problem(problem, Differentiation(), ["pose", "trans"])(x)
    peer_cost, peers = least_squares_problem(problem, Differentiation())(x)
    (gradient, arrow), (peer_gradient, dense) = derivatives(), peers()
    dense = dense.toarray() if scipy.sparse.issparse(dense) else dense
    assert cost == pytest.approx(peer_cost)
    np.testing.assert_allclose(gradient, peer_gradient, atol=1e-12)
    np.testing.assert_allclose(arrow.dense(), dense, atol=1e-12)
    np.testing.assert_allclose(arrow @ x, dense @ x, atol=1e-12)
    np.testing.assert_allclose(arrow.diagonal(), np.diagonal(dense), atol=1e-12)
    np.testing.assert_allclose(
        arrow.solve(0.1 + x**2, x), np.linalg.solve(dense + np.diag(0.1 + x**2), x), atol=1e-10
    )


def test_an_arrow_solve_ends_where_a_dense_one_does():
    start = {"pose": np.zeros((COUNT, 2)), "betas": np.ones(SHARED), "trans": np.zeros((COUNT, 1))}
    terms = arrow_terms("sparse", GemanMcClure(1.5))
    np.testing.assert_allclose(
        minimize(terms, start, blocks=["pose", "trans"]).x, minimize(terms, start).x, atol=1e-5
    )


def test_blocks_that_meet_or_do_not_match_are_refused():
    start = {"pose": np.zeros((COUNT, 2)), "betas": np.ones(SHARED)}
    joined = {"sum": lambda pose: (pose.sum(axis=0), {"pose": np.tile(np.eye(2), (1, COUNT))})}
    with pytest.raises(HabitusError, match="'sum' depends on two blocks"):
        minimize(joined, start, blocks=["pose"])
    with pytest.raises(HabitusError, match="same first axis"):
        minimize(joined, start, blocks=["pose", "betas"])


def test_the_weight_of_geman_mcclure_is_the_slope_of_its_loss():
    """d rho / d (d^2), by central differences; a quarter at the scale, none far away."""
    scale, distance, step = 0.3, np.linspace(0.0, 1.5, 16)[1:], 1e-6
    loss = GemanMcClure(scale).loss
    above, below = (loss(np.sqrt(distance**2 + h)[:, None]) for h in (step, -step))
    weight = geman_mcclure_weight(distance, scale)
    np.testing.assert_allclose(weight, (above - below) / (2 * step), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(weight, GemanMcClure(scale).weights(distance[:, None]), rtol=1e-12)
    assert geman_mcclure_weight(np.array([0.0, scale]), scale).tolist() == [1.0, 0.25]
