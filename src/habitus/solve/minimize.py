"""Minimise named residual terms of named tensors (T 4.5, `ch.minimize`)."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from habitus.errors import HabitusError
from habitus.solve.dogleg import Dogleg
from habitus.solve.lbfgs import lbfgs
from habitus.solve.least_squares import DEFAULT, SolveResult, Tolerances, descend
from habitus.solve.levenberg import Damped
from habitus.solve.term_derivatives import Differentiation, cost_and_gradient, least_squares_problem, too_large
from habitus.solve.terms import Objective, Unknowns

METHODS = ("dogleg", "levenberg", "lbfgs")
MODES = ("forward", "reverse")


@dataclass(frozen=True, eq=False)
class Minimized(SolveResult):
    """Where `minimize` ended: what SolveResult says, x being the values one after the other, and more.

    values: each free tensor, in the start's shape, dtype and device. costs: the weighted cost of each term, which sum
    to `cost`. method: what was used. seconds: from call to return.
    """

    values: dict[str, Tensor]
    costs: dict[str, float]
    method: str
    seconds: float


def minimize(
    objective: Callable[..., Any] | Mapping[str, Callable[..., Any]],
    free: Mapping[str, Tensor],
    method: str | None = None,
    *,
    weights: Mapping[str, float] | None = None,
    max_iterations: int = 200,
    tolerances: Tolerances = DEFAULT,
    callback: Callable[[int, dict[str, Tensor], float], bool | None] | None = None,
    mode: str | None = None,
    chunk_size: int | None = None,
) -> Minimized:
    """Move the free tensors to where the sum of weight * 1/2 |residual|^2 is least.

        def difference(translation, rotation):
            return pyramid(render(translation, rotation) - observed)

        result = minimize({"image": difference, "prior": lambda rotation: rotation}, start, weights={"prior": 1e-3})

    objective: a function, or named functions, the terms. A function names as its parameters the unknowns it takes,
    gets them as float64 tensors, and returns residuals of any shape, always as many;
    `functools.partial(difference, rotation=known)` holds one fixed. It may return (residual, Jacobians) instead: a
    mapping from each unknown it takes to a dense or scipy sparse matrix (residuals, numbers of the unknown), or a
    function of nothing that returns this mapping, which is called only where derivatives are needed. A number without
    axes is a cost itself, which only L-BFGS takes.

    method: "dogleg" or "levenberg" (Gauss-Newton steps) or "lbfgs" (SciPy's, gradients only; `lbfgs.py` tells how it
    reads tolerances). None is dogleg, but L-BFGS where a term is a cost or a dense Jacobian by autodiff exceeds 2 GiB.
    weights: of terms by name, 1 where not named; a term of weight 0 is not evaluated after the start.
    callback: (iteration, values, cost) after each iteration, accepted or refused; True stops.
    mode, chunk_size: of autodiff Jacobians, see `Differentiation`: "forward" by columns, "reverse" by rows.

    Raises HabitusError for free values or residuals that are no floating tensors, names that do not match, an unknown
    method or mode, a cost given to Gauss-Newton, Jacobians of another shape, and a number of residuals that changes.
    A start whose cost is not finite is a status, not an error; a free tensor that no term depends on stays.
    """
    began = time.perf_counter()
    if mode not in (None, *MODES) or (chunk_size is not None and chunk_size < 1):
        raise HabitusError(f"mode {mode!r}, chunk_size {chunk_size}; expected {' or '.join(MODES)}, and 1 or more")
    unknowns = Unknowns.of(free)
    problem = Objective.of(objective, weights, unknowns)
    method = _chosen(method, problem)
    settings: dict[str, Any] = {
        "max_iterations": max_iterations,
        "tolerances": tolerances,
        "callback": callback and (lambda k, x, cost: callback(k, unknowns.like_start(x), cost)),
    }
    if method == "lbfgs":
        result = lbfgs(lambda x: cost_and_gradient(problem, x), unknowns.vector, **settings)
    else:
        steps = Dogleg() if method == "dogleg" else Damped()
        function = least_squares_problem(problem, Differentiation(mode, chunk_size))
        result = descend(function, unknowns.vector, steps, stretch=True, **settings)
    values, costs = unknowns.like_start(result.x), problem.costs(result.x)
    seconds = time.perf_counter() - began
    return Minimized(**vars(result), values=values, costs=costs, method=method, seconds=seconds)


def _chosen(method: str | None, problem: Objective) -> str:
    """The method to use; HabitusError where the one asked for cannot."""
    if method not in (None, *METHODS):
        raise HabitusError(f"the method is {method!r}; expected one of {', '.join(METHODS)}")
    large, costs = too_large(problem), any(term.is_cost for term in problem.active)
    if method is None:
        return "lbfgs" if costs or large else "dogleg"
    if method != "lbfgs" and costs:
        raise HabitusError(
            f"{method} was given a number without axes, a cost; it needs residuals: return them unsquared, or use lbfgs"
        )
    if method != "lbfgs" and large:
        raise HabitusError(
            f"the dense Jacobian of the term {large!r} exceeds 2 GiB; return a sparse one beside its residual, "
            "or use lbfgs"
        )
    return method
