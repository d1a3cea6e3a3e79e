"""SciPy's L-BFGS-B behind the same interface as the least-squares solvers, for any cost with a
gradient.
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from habitus.solve.least_squares import DEFAULT, Callback, SolveResult, Tolerances

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

CostAndGradient = Callable[[np.ndarray], tuple[float, np.ndarray]]
"""x (N,) -> cost, gradient (N,)."""
_FIRST = 1e10


def lbfgs(
    function: CostAndGradient,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 200,
    tolerances: Tolerances = DEFAULT,
    callback: Callback | None = None,
) -> SolveResult:
    """Minimise any cost, which may be negative; x is best in units that make its numbers
    comparable.

    Of `tolerances`, cost is the fall of the cost in an iteration, relative to the cost or to 1e-10
    of the first one; gradient is the largest component relative to that at the start. A cost that
    is not finite shortens the step.
    """
    from scipy.optimize import minimize  # slow to import, and a marker fit gets by without it

    x = np.array(start, dtype=float)
    cost, gradient = function(x)
    if not (np.isfinite(cost) and np.isfinite(gradient).all()):
        return SolveResult(x, "not finite", float(cost), 0, (float(cost),))
    history = [float(cost)]
    where = [x]
    stopped = False
    if max_iterations < 1:
        return SolveResult(x, "iterations", history[0], 0, tuple(history))
    # SciPy takes falls relative to max(|cost|, 1): seen so large, the 1 does not matter. A power of
    # two rounds nothing.
    scale = math.ldexp(1.0, math.frexp(_FIRST / max(abs(cost), 1e-100))[1])

    def scaled(x: np.ndarray) -> tuple[float, np.ndarray]:
        with np.errstate(all="ignore"):
            cost, gradient = function(x)
        if np.isfinite(cost) and np.isfinite(gradient).all():
            return scale * cost, scale * gradient
        return scale * (history[-1] + abs(history[-1])) + 1.0, np.zeros(len(x))

    def after(intermediate_result: "OptimizeResult") -> None:
        nonlocal stopped
        history.append(float(intermediate_result.fun) / scale)
        where.append(np.array(intermediate_result.x))
        del where[:-1]
        if callback is not None and callback(len(history) - 1, where[-1], history[-1]):
            stopped = True
            raise StopIteration

    ended = minimize(
        scaled,
        x,
        jac=True,
        method="L-BFGS-B",
        callback=after,
        options={
            "maxiter": max_iterations,
            "maxfun": 100 * (max_iterations + 1),
            "ftol": tolerances.cost,
            "gtol": tolerances.gradient * scale * float(np.abs(gradient).max()),
        },
    )
    status = (
        "stopped" if stopped else {0: "converged", 1: "iterations"}.get(ended.status, "stalled")
    )
    return SolveResult(where[-1], status, history[-1], len(history) - 1, tuple(history))
