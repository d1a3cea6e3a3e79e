"""The two kinds of steps of the least-squares solver: Powell's dogleg and Levenberg-Marquardt.

Both measure steps in units of the Jacobian's column norms, so that metres, radians and betas may
mix. An object keeps its trust region or damping: given to several solves, it carries it over.
"""

import numpy as np

from habitus.solve.least_squares import Linearized, solve_damped


class Dogleg:
    """Powell's dogleg (Nocedal and Wright 2006, 4.1), MoSh's optimiser (M 6): steps inside a trust
    region, a ball of the scaled unknowns.
    """

    def __init__(self) -> None:
        self.radius = np.inf
        self._newton: np.ndarray | None = None

    def begin(self) -> None:
        """Another problem begins: the radius stays."""
        self._newton = None

    def propose(self, here: Linearized, scale: np.ndarray) -> np.ndarray:
        """Gauss-Newton's step, or as far towards it as the trust region goes."""
        if self._newton is None:
            self._newton = solve_damped(here, np.zeros(len(here.x)))
        return _dogleg_step(here, self._newton, scale, self.radius)

    def update(self, taken: bool, ratio: float, length: float) -> None:
        """Algorithm 4.1: shrink after a poor prediction, grow after a good one that met the
        boundary.
        """
        if ratio < 0.25:
            self.radius = 0.25 * length
        elif ratio > 0.75 and length > 0.99 * self.radius:
            self.radius = max(2.0 * self.radius, length)
        if taken:
            self._newton = None


class Levenberg:
    """Gauss-Newton steps with Nielsen's damping (Madsen, Nielsen, Tingleff 2004, Non-Linear Least
    Squares, 3.2), relative to the squared norms of the Jacobian's columns.
    """

    def __init__(self, damping: float = 1e-3) -> None:
        self.damping = damping
        self.growth = 2.0

    def begin(self) -> None:
        """Another problem begins: the damping stays, its growth starts anew."""
        self.growth = 2.0

    def propose(self, here: Linearized, scale: np.ndarray) -> np.ndarray:
        """The step that minimises the quadratic model plus the damping."""
        return solve_damped(here, self.damping * scale**2)

    def update(self, taken: bool, ratio: float, length: float) -> None:
        """Less damping after a good prediction, more and more of it while steps are refused."""
        if taken:
            self.damping = self.damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
            self.growth = 2.0
        else:
            self.damping = self.damping * self.growth
            self.growth = 2.0 * self.growth


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
