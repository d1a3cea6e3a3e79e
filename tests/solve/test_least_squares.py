"""Laws of the dense solvers: known minima, agreement with SciPy, both interfaces, numbers that go
wrong.
"""

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse

from habitus.solve.least_squares import (
    Dogleg,
    Levenberg,
    Linearized,
    Tolerances,
    descend,
    solve_damped,
)


def solver(kind):
    """A function that minimises 1/2 |r(x)|^2 by one kind of steps, of x -> residual, Jacobian."""

    def solve(function, start, max_iterations=200, **more):
        def problem(x):
            residual, jacobian = function(x)
            cost = 0.5 * float(residual @ residual)
            return cost, lambda: (jacobian.T @ residual, jacobian.T @ jacobian)

        return descend(problem, start, kind(), max_iterations=max_iterations, **more)

    return solve


dogleg, levenberg = SOLVERS = [solver(Dogleg), solver(Levenberg)]


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array(
        [[-20 * x[0], 10.0], [-1.0, 0.0]]
    )


def powell(x):
    """Powell's singular function: its Jacobian loses rank at the minimum."""
    a, b, c, d = x
    root5 = np.sqrt(5.0)
    root10 = np.sqrt(10.0)
    residual = np.array([a + 10 * b, root5 * (c - d), (b - 2 * c) ** 2, root10 * (a - d) ** 2])
    u = 2 * (b - 2 * c)
    v = 2 * root10 * (a - d)
    return residual, np.array(
        [[1, 10, 0, 0], [0, 0, root5, -root5], [0, u, -2 * u, 0], [v, 0, 0, -v]], dtype=float
    )


def curve(seed, rows=30, columns=6):
    """A random non-linear least-squares problem with residuals left at its minimum."""
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(rows, columns))
    target = rng.normal(size=rows)

    def function(x):
        inner = mix @ x
        return np.tanh(inner) + 0.3 * inner - target, (1 / np.cosh(inner) ** 2 + 0.3)[:, None] * mix

    return function, rng.normal(size=columns)


@pytest.mark.parametrize("solve", SOLVERS)
def test_rosenbrock(solve):
    result = solve(rosenbrock, [-1.2, 1.0])
    assert result.converged and result.cost < 1e-20
    np.testing.assert_allclose(result.x, [1, 1], atol=1e-8)


@pytest.mark.parametrize("solve", SOLVERS)
def test_powell_singular(solve):
    result = solve(powell, [3.0, -1.0, 0.0, 1.0])
    assert result.cost < 1e-12
    np.testing.assert_allclose(result.x, np.zeros(4), atol=2e-3)


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("seed", range(8))
def test_the_minimum_is_scipys(solve, seed):
    function, start = curve(seed)
    peer = scipy.optimize.least_squares(
        lambda x: function(x)[0], start, lambda x: function(x)[1], xtol=1e-14, gtol=1e-14
    )
    result = solve(function, start)
    assert result.converged
    assert result.cost <= peer.cost * (1 + 1e-9)
    np.testing.assert_allclose(result.x, peer.x, atol=1e-4)


@pytest.mark.parametrize("solve", SOLVERS)
def test_columns_of_very_different_units(solve):
    function, start = curve(11)
    units = 10.0 ** np.arange(-3, 3)
    scaled = solve(
        lambda y: (function(units * y)[0], function(units * y)[1] * units), start / units
    )
    np.testing.assert_allclose(units * scaled.x, solve(function, start).x, atol=1e-4)


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_linear_problem_takes_one_step(solve):
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(12, 4))
    target = rng.normal(size=12)
    result = solve(lambda x: (matrix @ x - target, matrix), np.zeros(4), max_iterations=60)
    np.testing.assert_allclose(result.x, np.linalg.lstsq(matrix, target, rcond=None)[0], atol=1e-6)
    assert solve is levenberg or result.iterations <= 2


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("wrap", [np.asarray, scipy.sparse.csr_array, scipy.sparse.csc_matrix])
def test_dense_and_sparse_give_the_same_steps(solve, wrap):
    function, start = curve(5)

    def wrapped(x):
        residual, jacobian = function(x)
        return residual, wrap(jacobian)

    expected = solve(function, start)
    result = solve(wrapped, start)
    np.testing.assert_allclose(result.x, expected.x, atol=1e-9)
    assert result.status == expected.status


@pytest.mark.parametrize("solve", SOLVERS)
def test_cost_never_rises(solve):
    for seed in range(5):
        function, start = curve(seed)
        history = solve(function, 10 * start).history
        assert (np.diff(history) <= 0).all()


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_start_that_is_not_finite_is_reported(solve):
    result = solve(lambda x: (np.full(2, np.nan), np.eye(2)), [1.0, 2.0])
    assert result.status == "not finite" and result.iterations == 0
    np.testing.assert_array_equal(result.x, [1.0, 2.0])


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_hole_in_the_domain_is_stepped_around(solve):
    """log is not finite below zero, where the first Gauss-Newton step would land."""

    def function(x):
        return np.log(x) - 1.0, np.diag(1 / x)

    result = solve(function, [40.0])
    assert result.converged
    np.testing.assert_allclose(result.x, [np.e], atol=1e-8)


@pytest.mark.parametrize("solve", SOLVERS)
def test_an_unknown_that_nothing_depends_on_stays(solve):
    result = solve(lambda x: (np.array([x[0] - 3.0]), np.array([[1.0, 0.0]])), [0.0, 7.0])
    np.testing.assert_allclose(result.x, [3.0, 7.0], atol=1e-8)


@pytest.mark.parametrize("solve", SOLVERS)
def test_limits_and_callbacks_stop(solve):
    assert solve(rosenbrock, [-1.2, 1.0], max_iterations=2).status == "iterations"
    seen = []
    result = solve(
        rosenbrock, [-1.2, 1.0], callback=lambda k, x, cost: seen.append((k, cost)) or k == 3
    )
    assert result.status == "stopped" and [k for k, _ in seen] == [1, 2, 3]
    loose = solve(rosenbrock, [-1.2, 1.0], tolerances=Tolerances(cost=0.5))
    assert loose.iterations < solve(rosenbrock, [-1.2, 1.0]).iterations


@pytest.mark.parametrize("share, flat", [(0.99, True), (1.01, False)])
def test_a_gradient_is_flat_where_the_residual_is_orthogonal_to_every_column(share, flat):
    """|g_k| <= tolerance |J_k| |r|, the second column the longer one."""
    jacobian = np.diag([1.0, 20.0])
    residual = np.array([3.0, 4.0])
    tolerance = 1e-4
    cost = 0.5 * residual @ residual
    for column, length in enumerate((1.0, 20.0)):
        gradient = np.zeros(2)
        gradient[column] = share * tolerance * length * np.linalg.norm(residual)
        assert (
            Linearized(np.zeros(2), cost, gradient, jacobian.T @ jacobian).flat(tolerance) == flat
        )


@pytest.mark.parametrize(
    "ratio, factor", [(1.0, 1 / 3), (0.5, 1.0), (0.25, 1.125), (0.9, 1 - 0.8**3), (3.0, 1 / 3)]
)
def test_damping_follows_how_well_a_step_was_foreseen(ratio, factor):
    steps = Levenberg(0.1)
    steps.update(True, ratio, 1.0)
    assert steps.damping == pytest.approx(0.1 * factor)


def test_every_step_refused_in_a_row_is_damped_twice_as_much_more():
    steps = Levenberg(1.0)
    seen = []
    for taken in (False, False, False, True, False):
        steps.update(taken, 0.5, 1.0)
        seen.append(steps.damping)
    assert seen == [2.0, 8.0, 64.0, 64.0, 128.0]


def test_where_no_damping_helps_the_step_goes_down_the_gradient():
    here = Linearized(np.zeros(2), 1.0, np.array([3.0, -4.0]), np.diag([-1e40, 4.0]))
    np.testing.assert_allclose(solve_damped(here, np.array([1e-3, 4e-3])), [-3.0, 1.0])
