"""Powell's dogleg method with Gauss-Newton matrices (Nocedal and Wright 2006, 4.1): MoSh's
optimiser (M 6).

The trust region is a ball in units of the Jacobian's column norms, so that metres, radians and
betas may mix.
"""

from collections.abc import Sequence

import numpy as np

from habitus.solve.least_squares import (
    DEFAULT,
    Callback,
    Linearized,
    NormalEquations,
    Residuals,
    SolveResult,
    Tolerances,
    at_once,
    descend,
    normal_equations,
    solve_damped,
)


def dogleg(
    function: Residuals,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 100,
    tolerances: Tolerances = DEFAULT,
    callback: Callback | None = None,
) -> SolveResult:
    """Minimise 1/2 |r(x)|^2; `function` returns the residual (R,) and its Jacobian (R, N), dense or
    sparse.
    """
    evaluate = normal_equations(function)
    return dogleg_normal(
        evaluate, start, max_iterations=max_iterations, tolerances=tolerances, callback=callback
    )


def dogleg_normal(
    function: NormalEquations,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 100,
    tolerances: Tolerances = DEFAULT,
    callback: Callback | None = None,
) -> SolveResult:
    """The same for a `function` that returns cost, gradient (N,) and Gauss-Newton matrix (N, N),
    dense or sparse.
    """
    return descend(
        at_once(function),
        start,
        Dogleg(),
        max_iterations=max_iterations,
        tolerances=tolerances,
        callback=callback,
    )


class Dogleg:
    """Steps inside a trust region."""

    def __init__(self) -> None:
        self.radius = np.inf
        self._newton: np.ndarray | None = None

    def propose(self, here: Linearized, scale: np.ndarray) -> np.ndarray:
        """Gauss-Newton's step, or as far towards it as the trust region goes."""
        if self._newton is None:
            self._newton = solve_damped(here, np.zeros(len(here.x)))
        return _dogleg_step(here, self._newton, scale, self.radius)

    def learn(self, taken: bool, ratio: float, length: float) -> None:
        """Algorithm 4.1: shrink after a poor prediction, grow after a good one that met the
        boundary.
        """
        if ratio < 0.25:
            self.radius = 0.25 * length
        elif ratio > 0.75 and length > 0.99 * self.radius:
            self.radius = max(2.0 * self.radius, length)
        if taken:
            self._newton = None


def _dogleg_step(
    here: Linearized, newton: np.ndarray, scale: np.ndarray, radius: float
) -> np.ndarray:
    """From the steepest descent's minimum towards Gauss-Newton's, as far as the trust region goes
    (equation 4.16).
    """
    if np.linalg.norm(scale * newton) <= radius:
        return newton
    descent = -here.gradient / scale**2
    curvature = float(descent @ (here.matrix @ descent))
    slope = float(-(here.gradient @ descent))
    cauchy = descent * (slope / curvature) if curvature > 0.0 else descent * np.inf
    length = float(np.linalg.norm(scale * cauchy))
    if not length < radius:
        return descent * (radius / np.linalg.norm(scale * descent))
    p = scale * cauchy
    d = scale * (newton - cauchy)
    a = float(d @ d)
    b = float(p @ d)
    c = float(p @ p) - radius**2
    share = (-b + np.sqrt(max(b * b - a * c, 0.0))) / a
    return cauchy + min(share, 1.0) * (newton - cauchy)
