"""What every least-squares solver here shares: the linearised problem, two kinds of steps, the
loop, the result, and when to stop.

cost(x) = 1/2 |r(x)|^2, gradient = J^T r, and the Gauss-Newton matrix J^T J in place of the second
derivative. Steps are Powell's dogleg or Levenberg-Marquardt's; both are measured in units of the
Jacobian's column norms, so that metres, radians and betas may mix. An object keeps its trust region
or damping: given to several solves, it carries it over.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Bool, Float

from habitus.solve.arrow import ArrowMatrix

Matrix = Any
"""A numpy array, a scipy sparse matrix or an ArrowMatrix."""
Derivatives = Callable[[], tuple[np.ndarray, Matrix]]
"""Nothing -> gradient (N,), Gauss-Newton matrix (N, N)."""
Problem = Callable[[np.ndarray], tuple[float, Derivatives]]
"""x (N,) -> cost, and the derivatives for whoever asks: a refused step does not."""
Callback = Callable[[int, np.ndarray, float], bool | None]
"""(iteration, x, cost) after each iteration; True stops."""

ACCEPT = 1e-4
"""Share of the predicted decrease of the cost that a step must reach to be taken."""
STRETCH = 1.5
"""Actual over predicted decrease from which on a longer step is tried: a quadratic cost falls as
predicted, 1.
"""


@dataclass(frozen=True)
class Tolerances:
    """When a solve counts as converged; each is relative, and any one of them suffices.

    cost: predicted and actual decrease of the cost. step: step length against that of x, both
    scaled by the columns' norms. gradient: largest cosine between the residual and a column of the
    Jacobian.
    """

    cost: float = 1e-12
    step: float = 1e-10
    gradient: float = 1e-12


DEFAULT = Tolerances()


@dataclass(frozen=True)
class SolveResult:
    """Where a solve ended: x (N,), cost 1/2 |r|^2, accepted and refused steps together, the cost
    after each of them.

    status: "converged", "iterations" (the limit came first), "stalled" (no step lowers the cost),
    "stopped" (by the callback) or "not finite" (the start has no finite cost; x is the start).
    """

    x: Float[np.ndarray, " N"]
    status: str
    cost: float
    iterations: int
    history: tuple[float, ...]

    @property
    def converged(self) -> bool:
        """Whether the tolerances were met."""
        return self.status == "converged"


@dataclass(frozen=True)
class Linearized:
    """The problem around x: cost, gradient (N,) and Gauss-Newton matrix (N, N)."""

    x: Float[np.ndarray, " N"]
    cost: float
    gradient: Float[np.ndarray, " N"]
    matrix: Matrix

    @property
    def finite(self) -> bool:
        """Whether cost, gradient and matrix are all finite numbers."""
        values = self.matrix if isinstance(self.matrix, np.ndarray) else self.matrix.data
        return bool(
            np.isfinite(self.cost)
            and np.isfinite(self.gradient).all()
            and np.isfinite(values).all()
        )

    @property
    def diagonal(self) -> Float[np.ndarray, " N"]:
        """Squared norms of the Jacobian's columns."""
        return self.matrix.diagonal()

    def predicted_decrease(self, step: np.ndarray) -> float:
        """How much the quadratic model falls along a step: -(g . p + p . H p / 2)."""
        return -float(self.gradient @ step + 0.5 * (step @ (self.matrix @ step)))

    def flat(self, tolerance: float) -> bool:
        """Whether the residual is orthogonal to every column: |g_k| <= tolerance |J_k| |r|."""
        bound = tolerance * np.sqrt(np.maximum(self.diagonal, 0.0) * 2.0 * self.cost)
        return bool((np.abs(self.gradient) <= bound).all())


def restricted(problem: Problem, held: Bool[np.ndarray, " N"]) -> Problem:
    """The problem with some numbers of x held: their gradient is zero, their rows and columns of
    the matrix those of the identity.
    """

    def evaluate(x: np.ndarray) -> tuple[float, Derivatives]:
        cost, derivatives = problem(x)

        def some() -> tuple[np.ndarray, Matrix]:
            gradient, matrix = derivatives()
            return np.where(held, 0.0, gradient), _held(matrix, held)

        return cost, some

    return evaluate


def _held(matrix: Matrix, held: Bool[np.ndarray, " N"]) -> Matrix:
    if isinstance(matrix, ArrowMatrix):
        return matrix.held(held)
    free = scipy.sparse.diags_array((~held).astype(float))
    if scipy.sparse.issparse(matrix):
        return (free @ matrix @ free + scipy.sparse.diags_array(held.astype(float))).tocsc()
    out = np.where(held[:, None] | held, 0.0, matrix)
    out[held, held] = 1.0
    return out


class Steps(Protocol):
    """A kind of steps: the next one to try, and what changes after it."""

    def begin(self) -> None:
        """Another problem begins: what belongs to the last point is forgotten."""
        ...

    def propose(self, here: Linearized, scale: np.ndarray) -> np.ndarray:
        """The step (N,) to try from here; scale (N,) holds the norms of the Jacobian's columns."""
        ...

    def update(self, accepted: bool, ratio: float, length: float) -> None:
        """ratio: actual over predicted decrease of the cost, 0 for a refused step; length: of the
        step, scaled.
        """
        ...


def descend(
    problem: Problem,
    start: np.ndarray | Sequence[float],
    steps: Steps,
    *,
    max_iterations: int,
    tolerances: Tolerances = DEFAULT,
    callback: Callback | None = None,
    stretch: bool = False,
    limit: Callable[[np.ndarray], np.ndarray] | None = None,
    max_accepted: int | None = None,
) -> SolveResult:
    """Minimise with one kind of steps; derivatives are computed at the start and after steps that
    were accepted.

    stretch: double a step as long as that pays, where the cost falls much faster than predicted.
    Images ask for it: an edge that is k pixels off has a cost linear in k, and a Jacobian of one
    pixel only. limit: cuts a step (N,) that is too long; no step is then doubled. max_accepted:
    ends with status "iterations" after so many accepted steps; no derivatives are computed at the
    last.
    """
    x = np.array(start, dtype=float)
    cost, derivatives = _cost_at(problem, x)
    here = _linearized(x, cost, derivatives) if np.isfinite(cost) else None
    if here is None or not here.finite:
        return SolveResult(x, "not finite", cost, 0, (cost,))
    history = [here.cost]
    status = "iterations"
    scale = column_scale(here.diagonal)
    steps.begin()
    accepted = 0
    while len(history) <= max_iterations:
        if here.flat(tolerances.gradient):
            status = "converged"
            break
        step = steps.propose(here, scale)
        step = step if limit is None else limit(step)
        cost, derivatives = _cost_at(problem, here.x + step)
        predicted = here.predicted_decrease(step)
        cost_decrease = here.cost - cost
        step_accepted = bool(
            np.isfinite(cost) and cost_decrease > 0.0 and cost_decrease >= ACCEPT * predicted
        )
        if stretch and limit is None and step_accepted and cost_decrease > STRETCH * predicted:
            step, cost, derivatives = _stretched(problem, here.x, step, cost, derivatives)
            cost_decrease = here.cost - cost
        length = float(np.linalg.norm(scale * step))
        size = float(np.linalg.norm(scale * here.x))
        last = step_accepted and accepted + 1 == max_accepted
        if last:
            trial = replace(here, x=here.x + step, cost=cost)
        else:
            trial = _linearized(here.x + step, cost, derivatives) if step_accepted else here
        step_accepted = step_accepted and trial.finite
        status = verdict(tolerances, here, predicted, cost_decrease, length, size, step_accepted)
        steps.update(
            step_accepted,
            cost_decrease / predicted if step_accepted and predicted > 0.0 else 0.0,
            length,
        )
        accepted += step_accepted
        if step_accepted:
            here = trial
            scale = np.maximum(scale, column_scale(trial.diagonal))
        history.append(here.cost)
        if callback is not None and callback(len(history) - 1, here.x, here.cost):
            status = "stopped"
        if status != "iterations" or last:
            break
    return SolveResult(here.x, status, here.cost, len(history) - 1, tuple(history))


def _stretched(
    problem: Problem, x: np.ndarray, step: np.ndarray, cost: float, derivatives: Derivatives
) -> tuple[np.ndarray, float, Derivatives]:
    """The step doubled as often as the cost falls further, at most ten times, and what is found
    there.
    """
    for _ in range(10):
        further, there = _cost_at(problem, x + 2.0 * step)
        if not further < cost:
            break
        step = 2.0 * step
        cost = further
        derivatives = there
    return step, cost, derivatives


def _cost_at(problem: Problem, x: np.ndarray) -> tuple[float, Derivatives]:
    """Overflow and the like show up as not finite, not as warnings."""
    with np.errstate(all="ignore"):
        cost, derivatives = problem(x)
    return float(cost), derivatives


def _linearized(x: np.ndarray, cost: float, derivatives: Derivatives) -> Linearized:
    with np.errstate(all="ignore"):
        gradient, matrix = derivatives()
    return Linearized(x, cost, np.asarray(gradient, dtype=float).reshape(-1), matrix)


def column_scale(diagonal: np.ndarray) -> np.ndarray:
    """Norms of the Jacobian's columns, the units in which steps are measured; 1 where a column is
    zero.
    """
    norms = np.sqrt(np.maximum(diagonal, 0.0))
    return np.where(norms > 1e-12 * max(norms.max(initial=0.0), 1e-300), norms, 1.0)


def solve_damped(here: Linearized, damping: np.ndarray) -> np.ndarray:
    """The step p with (H + diag(damping)) p = -g; damping grows tenfold until the matrix is
    positive definite.
    """
    floor = 1e-15 * column_scale(here.diagonal) ** 2
    for _ in range(20):
        step = _solve(here.matrix, damping, -here.gradient)
        if step is not None:
            return step
        floor *= 10.0
        damping = np.maximum(10.0 * damping, floor)
    return -here.gradient / column_scale(here.diagonal) ** 2


def verdict(
    tolerances: Tolerances,
    here: Linearized,
    predicted: float,
    cost_decrease: float,
    length: float,
    size: float,
    accepted: bool,
) -> str:
    """Status after a step of scaled `length`, x being of scaled `size`; "iterations" means go
    on.
    """
    small = length <= tolerances.step * (size + tolerances.step)
    if accepted:
        quiet = max(predicted, cost_decrease) <= tolerances.cost * here.cost
        return "converged" if small or quiet or here.cost == cost_decrease else "iterations"
    if predicted <= tolerances.cost * here.cost:
        return "converged"
    return "stalled" if small else "iterations"


def _solve(matrix: Matrix, damping: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    try:
        if isinstance(matrix, ArrowMatrix):
            step = matrix.solve(damping, right)
        elif scipy.sparse.issparse(matrix):
            step = scipy.sparse.linalg.splu((matrix + scipy.sparse.diags(damping)).tocsc()).solve(
                right
            )
        else:
            damped = np.array(matrix, dtype=float)
            damped.flat[:: len(damped) + 1] += damping
            step = scipy.linalg.cho_solve(
                scipy.linalg.cho_factor(damped, overwrite_a=True, check_finite=False), right
            )
    except (scipy.linalg.LinAlgError, RuntimeError):
        return None
    return step if np.isfinite(step).all() and right @ step >= 0.0 else None


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

    def update(self, accepted: bool, ratio: float, length: float) -> None:
        """Algorithm 4.1: shrink after a poor prediction, grow after a good one that met the
        boundary.
        """
        if ratio < 0.25:
            self.radius = 0.25 * length
        elif ratio > 0.75 and length > 0.99 * self.radius:
            self.radius = max(2.0 * self.radius, length)
        if accepted:
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

    def update(self, accepted: bool, ratio: float, length: float) -> None:
        """Less damping after a good prediction, more and more of it while steps are refused."""
        if accepted:
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
