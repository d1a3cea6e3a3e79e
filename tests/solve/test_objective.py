"""An objective evaluates each term once a point, whoever asks: solver, costs, derivatives."""

import numpy as np
import pytest

from habitus.solve.minimize import minimize
from habitus.solve.objective import Differentiation, Objective, least_squares_problem
from habitus.solve.terms import Term, Unknowns


class Counted:
    """(x - target) with its Jacobian, and the points at which it was asked."""

    def __init__(self, target):
        self.target = np.asarray(target, dtype=float)
        self.points = []

    def __call__(self, x):
        self.points.append(x.tobytes())
        return x - self.target, lambda: {"x": np.eye(len(x))}


def objective(weights=None, **terms):
    return Objective.of(
        {name: Term(term) for name, term in terms.items()}, weights, Unknowns.of({"x": np.zeros(2)})
    )


def test_the_two_latest_points_are_remembered_and_no_more():
    term = Counted([1.0, 2.0])
    made = objective(term=term)
    points = [np.zeros(2), np.ones(2), np.full(2, 2.0)]
    for x in (points[0], points[0], points[1], points[0], points[1]):
        made.evaluate(x)
    assert len(term.points) == 2  # the start was evaluated when the objective was made
    made.evaluate(points[2])  # leaves out the older of the two, the start
    made.evaluate(points[1])
    assert len(term.points) == 3
    made.evaluate(points[0])
    assert len(term.points) == 4


def test_costs_and_derivatives_at_a_point_evaluate_it_once():
    term = Counted([1.0, 2.0])
    made = objective(term=term)
    evaluate = least_squares_problem(made, Differentiation())
    x = np.array([3.0, -1.0])
    _, derivatives = evaluate(x)
    derivatives()
    assert made.costs(x) == {"term": pytest.approx(6.5)} and term.points.count(x.tobytes()) == 1


def test_a_term_of_no_weight_is_named_and_never_evaluated_again():
    one = Counted([1.0, 0.0])
    other = Counted([0.0, 1.0])
    made = objective({"other": 0.0}, one=one, other=other)
    assert made.costs(np.array([2.0, 0.0])) == {"one": pytest.approx(0.5), "other": 0.0}
    assert len(other.points) == 1


def test_a_solve_asks_no_point_twice():
    term = Counted([1.0, 2.0])
    found = minimize({"term": Term(term)}, {"x": np.zeros(2)}, method="dogleg")
    np.testing.assert_allclose(found.values["x"], [1.0, 2.0], atol=1e-9)
    assert len(term.points) == len(set(term.points))
