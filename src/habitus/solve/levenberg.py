"""Levenberg-Marquardt with Nielsen's damping (Madsen, Nielsen, Tingleff 2004, Non-Linear Least Squares, 3.2)."""

from collections.abc import Sequence

import numpy as np

from habitus.solve.least_squares import (
    ACCEPT,
    DEFAULT,
    Callback,
    NormalEquations,
    Residuals,
    SolveResult,
    Tolerances,
    column_scale,
    linearized,
    normal_equations,
    solve_damped,
    verdict,
)


def levenberg(
    function: Residuals,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 200,
    tolerances: Tolerances = DEFAULT,
    damping: float = 1e-3,
    callback: Callback | None = None,
) -> SolveResult:
    """Minimise 1/2 |r(x)|^2; `function` returns the residual (R,) and its Jacobian (R, N), dense or sparse.

    damping: the first lambda, relative to the squared norms of the Jacobian's columns.
    """
    return levenberg_normal(
        normal_equations(function),
        start,
        max_iterations=max_iterations,
        tolerances=tolerances,
        damping=damping,
        callback=callback,
    )


def levenberg_normal(
    function: NormalEquations,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 200,
    tolerances: Tolerances = DEFAULT,
    damping: float = 1e-3,
    callback: Callback | None = None,
) -> SolveResult:
    """The same for a `function` that returns cost, gradient (N,) and Gauss-Newton matrix (N, N), dense or sparse."""
    here = linearized(function, np.array(start, dtype=float))
    history, growth = [here.cost], 2.0
    if not here.finite:
        return SolveResult(here.x, "not finite", here.cost, 0, tuple(history))
    status, scale = "iterations", column_scale(here.diagonal)
    while len(history) <= max_iterations:
        if here.flat(tolerances.gradient):
            status = "converged"
            break
        step = solve_damped(here, damping * scale**2)
        trial = linearized(function, here.x + step)
        length = float(np.linalg.norm(scale * step))
        predicted, fall = here.predicted_fall(step), here.cost - trial.cost
        taken = trial.finite and fall > 0.0 and fall >= ACCEPT * predicted
        status = verdict(tolerances, here, predicted, fall, length, float(np.linalg.norm(scale * here.x)), taken)
        if taken:
            here, scale = trial, np.maximum(scale, column_scale(trial.diagonal))
            damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * fall / predicted - 1.0) ** 3), 2.0
        else:
            damping, growth = damping * growth, 2.0 * growth
        history.append(here.cost)
        if callback is not None and callback(len(history) - 1, here.x, here.cost):
            status = "stopped"
        if status != "iterations":
            break
    return SolveResult(here.x, status, here.cost, len(history) - 1, tuple(history))
