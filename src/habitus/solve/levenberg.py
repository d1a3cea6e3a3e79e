"""Levenberg-Marquardt with Nielsen's damping (Madsen, Nielsen, Tingleff 2004, Non-Linear Least
Squares, 3.2).
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


def levenberg(
    function: Residuals,
    start: np.ndarray | Sequence[float],
    *,
    max_iterations: int = 200,
    tolerances: Tolerances = DEFAULT,
    damping: float = 1e-3,
    callback: Callback | None = None,
) -> SolveResult:
    """Minimise 1/2 |r(x)|^2; `function` returns the residual (R,) and its Jacobian (R, N), dense or
    sparse.

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
    """The same for a `function` that returns cost, gradient (N,) and Gauss-Newton matrix (N, N),
    dense or sparse.
    """
    steps = Damped(damping)
    return descend(
        at_once(function),
        start,
        steps,
        max_iterations=max_iterations,
        tolerances=tolerances,
        callback=callback,
    )


class Damped:
    """Gauss-Newton steps with a damping relative to the squared norms of the Jacobian's columns."""

    def __init__(self, damping: float = 1e-3) -> None:
        self.damping = damping
        self.growth = 2.0

    def propose(self, here: Linearized, scale: np.ndarray) -> np.ndarray:
        """The step that minimises the quadratic model plus the damping."""
        return solve_damped(here, self.damping * scale**2)

    def learn(self, taken: bool, ratio: float, length: float) -> None:
        """Less damping after a good prediction, more and more of it while steps are refused."""
        if taken:
            self.damping = self.damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
            self.growth = 2.0
        else:
            self.damping = self.damping * self.growth
            self.growth = 2.0 * self.growth
