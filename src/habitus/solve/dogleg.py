"""Powell's dogleg method with Gauss-Newton matrices (Nocedal and Wright 2006, 4.1): MoSh's optimiser (M 6).

The trust region is a ball in units of the Jacobian's column norms, so that metres, radians and betas may mix.
"""

from collections.abc import Sequence

import numpy as np

from habitus.solve.least_squares import (
    ACCEPT,
    DEFAULT,
    Callback,
    Linearized,
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


def dogleg(
    function: Residuals,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 100,
    tolerances: Tolerances = DEFAULT,
    callback: Callback | None = None,
) -> SolveResult:
    """Minimise 1/2 |r(x)|^2; `function` returns the residual (R,) and its Jacobian (R, N), dense or sparse."""
    evaluate = normal_equations(function)
    return dogleg_normal(evaluate, start, max_iterations=max_iterations, tolerances=tolerances, callback=callback)


def dogleg_normal(
    function: NormalEquations,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 100,
    tolerances: Tolerances = DEFAULT,
    callback: Callback | None = None,
) -> SolveResult:
    """The same for a `function` that returns cost, gradient (N,) and Gauss-Newton matrix (N, N), dense or sparse."""
    here = linearized(function, np.array(start, dtype=float))
    history = [here.cost]
    if not here.finite:
        return SolveResult(here.x, "not finite", here.cost, 0, tuple(history))
    status, scale, radius = "iterations", column_scale(here.diagonal), np.inf
    newton: np.ndarray | None = None
    while len(history) <= max_iterations:
        if here.flat(tolerances.gradient):
            status = "converged"
            break
        newton = solve_damped(here, np.zeros(len(here.x))) if newton is None else newton
        step = _dogleg_step(here, newton, scale, radius)
        trial = linearized(function, here.x + step)
        length = float(np.linalg.norm(scale * step))
        predicted, fall = here.predicted_fall(step), here.cost - trial.cost
        taken = trial.finite and fall > 0.0 and fall >= ACCEPT * predicted
        status = verdict(tolerances, here, predicted, fall, length, float(np.linalg.norm(scale * here.x)), taken)
        radius = _next_radius(radius, length, fall / predicted if taken and predicted > 0.0 else 0.0)
        if taken:
            here, newton, scale = trial, None, np.maximum(scale, column_scale(trial.diagonal))
        history.append(here.cost)
        if callback is not None and callback(len(history) - 1, here.x, here.cost):
            status = "stopped"
        if status != "iterations":
            break
    return SolveResult(here.x, status, here.cost, len(history) - 1, tuple(history))


def _dogleg_step(here: Linearized, newton: np.ndarray, scale: np.ndarray, radius: float) -> np.ndarray:
    """From the steepest descent's minimum towards Gauss-Newton's, as far as the trust region goes (equation 4.16)."""
    if np.linalg.norm(scale * newton) <= radius:
        return newton
    descent = -here.gradient / scale**2
    curvature = float(descent @ (here.matrix @ descent))
    slope = float(-(here.gradient @ descent))
    cauchy = descent * (slope / curvature) if curvature > 0.0 else descent * np.inf
    length = float(np.linalg.norm(scale * cauchy))
    if not length < radius:
        return descent * (radius / np.linalg.norm(scale * descent))
    p, d = scale * cauchy, scale * (newton - cauchy)
    a, b, c = float(d @ d), float(p @ d), float(p @ p) - radius**2
    share = (-b + np.sqrt(max(b * b - a * c, 0.0))) / a
    return cauchy + min(share, 1.0) * (newton - cauchy)


def _next_radius(radius: float, length: float, ratio: float) -> float:
    """Algorithm 4.1: shrink after a poor prediction, grow after a good one that met the boundary."""
    if ratio < 0.25:
        return 0.25 * length
    if ratio > 0.75 and length > 0.99 * radius:
        return 2.0 * radius
    return radius
