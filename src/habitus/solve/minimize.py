"""Minimise named residual terms of named arrays or tensors (T 4.5, `ch.minimize`).

`minimize` moves the unknowns of fixed terms. `alternate` is for iterated closest points and the
like, whose terms are made anew at each state:

    for each stage, for each step:    terms = terms_at(state)    state = a step of minimize(terms)

Correspondences, visibility and robust weights are held within a step, which is accepted only where
it lowers the cost of the terms it was made for. Trust region or damping carry over from step to
step.
"""

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool

from habitus.errors import HabitusError
from habitus.solve.arrow_terms import arrow_problem
from habitus.solve.lbfgs import lbfgs
from habitus.solve.least_squares import (
    DEFAULT,
    Dogleg,
    Levenberg,
    SolveResult,
    Steps,
    Tolerances,
    descend,
    restricted,
)
from habitus.solve.objective import (
    Differentiation,
    Objective,
    cost_and_gradient,
    least_squares_problem,
    too_large,
)
from habitus.solve.terms import Term, Unknowns

METHODS = ("dogleg", "levenberg", "lbfgs")
MODES = ("forward", "reverse")


@dataclass(frozen=True, eq=False)
class Minimized(SolveResult):
    """Where `minimize` ended: what SolveResult says, x being the free values one after the other,
    and more.

    values: each value, in the start's shape, dtype and kind; fixed ones as given. state: the same
    as the start's dataclass, or the mapping where it was one. costs: the weighted cost of each
    term, which sum to `cost`. method: what was used. seconds: from call to return.
    """

    values: dict[str, Any]
    state: Any
    costs: dict[str, float]
    method: str
    seconds: float


def minimize(
    objective: Callable[..., Any] | Term | Mapping[str, Callable[..., Any] | Term],
    free: Any,
    method: str | Steps | None = None,
    *,
    fixed: Collection[str] = (),
    masks: Mapping[str, Any] | None = None,
    weights: Mapping[str, float] | None = None,
    max_iterations: int = 200,
    tolerances: Tolerances = DEFAULT,
    callback: Callable[[int, dict[str, Any], float], bool | None] | None = None,
    mode: str | None = None,
    chunk_size: int | None = None,
    blocks: Collection[str] = (),
    stretch: bool = True,
    max_step: Mapping[str, float] | None = None,
    max_accepted: int | None = None,
) -> Minimized:
    """Move the free values to where the sum of weight * 1/2 |residual|^2 is least.

        def difference(translation, rotation):
            return pyramid(render(translation, rotation) - observed)

        result = minimize({"image": difference, "prior": Term(lambda rotation: rotation,
        weight=1e-3)}, start)

    objective: a function or `Term`, or a dictionary of them, the terms (`habitus.solve.terms.Term`
    says what a residual function takes and returns). A number without axes is a cost itself, which
    only L-BFGS takes. free: start values by name, NumPy arrays or torch tensors, or a dataclass of
    them (fields that are None are left out). Terms are given float64 arrays, or float64 tensors as
    soon as one value is a tensor or autodiff is needed. fixed: names that stay as they are; terms
    take them like the others. masks: of an unknown, which of its numbers are free, True or False in
    its shape (or broadcast to it), as {"betas": np.arange(16) < 10}.

    method: "dogleg" or "levenberg" (Gauss-Newton steps) or "lbfgs" (SciPy's, gradients only;
    `lbfgs.py` says how it reads tolerances), or an object of `habitus.solve.least_squares`, which
    carries its damping or trust region over from one call to the next. None is dogleg, but L-BFGS
    where a term is a cost or a dense Jacobian by autodiff exceeds 2 GiB. weights: of terms by name,
    in place of the terms' own; a term of weight 0 is not evaluated after the start. callback:
    (iteration, values, cost) after each iteration, accepted or refused; True stops. mode,
    chunk_size: of autodiff Jacobians, see `Differentiation`: "forward" by columns, "reverse" by
    rows. blocks: unknowns (F, ...) whose F entries meet only through the other unknowns, as poses
    of frames do through a common shape: Gauss-Newton steps are then solved as an arrow matrix
    (`habitus.solve.arrow`). stretch: double steps as long as that pays (images ask for it).
    max_step: by unknown, the most that one of its numbers may change in a step; longer steps are
    cut, all unknowns alike. max_accepted: accepted steps after which it ends with status
    "iterations".

    Raises HabitusError for free values or residuals that are not floating, names that do not match,
    an unknown method or mode, a cost given to Gauss-Newton, Jacobians of another shape, a number of
    residuals that changes, and terms without Jacobians where PyTorch is not installed. A start
    whose cost is not finite is a status, not an error; a free value that no term depends on stays.
    """
    began = time.perf_counter()
    if mode not in (None, *MODES) or (chunk_size is not None and chunk_size < 1):
        raise HabitusError(
            f"mode {mode!r}, chunk_size {chunk_size}; expected {' or '.join(MODES)}, and 1 or more"
        )
    unknowns = Unknowns.of(free, fixed)
    problem = Objective.of(objective, weights, unknowns)
    name = _chosen(_name(method), problem)
    held = unknowns.held(masks or {})
    limits: dict[str, Any] = {
        "max_iterations": max_iterations,
        "tolerances": tolerances,
        "callback": callback and (lambda k, x, cost: callback(k, unknowns.like_start(x), cost)),
    }
    if name == "lbfgs":
        result = lbfgs(_gradient_problem(problem, held), unknowns.vector, **limits)
    else:
        result = descend(
            _normal_equations(problem, Differentiation(mode, chunk_size), blocks, held),
            unknowns.vector,
            _steps(method, name),
            stretch=stretch,
            limit=(lambda step: unknowns.limited(step, max_step)) if max_step else None,
            max_accepted=max_accepted,
            **limits,
        )
    return _minimized(result, free, problem, unknowns, name, began)


def _normal_equations(
    problem: Objective,
    how: Differentiation,
    blocks: Collection[str],
    held: Bool[np.ndarray, " N"] | None,
) -> Callable[[np.ndarray], Any]:
    """The Gauss-Newton problem that `descend` takes, of an arrow matrix where there are blocks,
    over what is not held.
    """
    function = (
        arrow_problem(problem, how, blocks) if blocks else least_squares_problem(problem, how)
    )
    return function if held is None else restricted(function, held)


def _steps(method: str | Steps | None, name: str) -> Steps:
    """The step object that was given, or a new one of the method of this name."""
    if not isinstance(method, str | None):
        return method
    return Dogleg() if name == "dogleg" else Levenberg()


def _minimized(
    result: SolveResult, free: Any, problem: Objective, unknowns: Unknowns, name: str, began: float
) -> Minimized:
    """The result with values by name, in the start's form, and the cost of each term."""
    values = unknowns.like_start(result.x)
    return Minimized(
        **vars(result),
        values=values,
        state=replace(free, **values)
        if is_dataclass(free) and not isinstance(free, type)
        else values,
        costs=problem.costs(result.x),
        method=name,
        seconds=time.perf_counter() - began,
    )


def _name(method: str | Steps | None) -> str | None:
    if isinstance(method, str | None):
        return method
    return "dogleg" if isinstance(method, Dogleg) else "levenberg"


def _gradient_problem(
    problem: Objective, held: Bool[np.ndarray, " N"] | None
) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
    """Cost and gradient, zero for what is held."""

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
        cost, gradient = cost_and_gradient(problem, x)
        return cost, gradient if held is None else np.where(held, 0.0, gradient)

    return evaluate


def _chosen(method: str | None, problem: Objective) -> str:
    """The method to use; HabitusError where the one asked for cannot."""
    if method not in (None, *METHODS):
        raise HabitusError(f"the method is {method!r}; expected one of {', '.join(METHODS)}")
    large = too_large(problem)
    costs = any(term.is_cost for term in problem.active)
    if method is None:
        return "lbfgs" if costs or large else "dogleg"
    if method != "lbfgs" and costs:
        raise HabitusError(
            f"{method} was given a number without axes, a cost; it needs residuals: return them "
            "unsquared, or use lbfgs"
        )
    if method != "lbfgs" and large:
        raise HabitusError(
            f"the dense Jacobian of the term {large!r} exceeds 2 GiB; return a sparse one beside "
            "its residual, "
            "or use lbfgs"
        )
    return method


REFUSALS = 8
"""Steps in a row that may be refused before new terms are made: damping then is up by 2^36."""


@dataclass(frozen=True)
class Stage:
    """Steps that move the same unknowns; a recipe derives its own stages from it, with fields of
    its own.

    steps: how often terms are made anew. fixed: unknowns that do not move. masks: which numbers of
    an unknown are free. max_step: by unknown, the most that one of its numbers changes in a step.
    until: the stage ends early where a step is smaller than these tolerances; None takes all steps.
    """

    steps: int = 10
    fixed: tuple[str, ...] = ()
    masks: Mapping[str, Any] = field(default_factory=dict)
    max_step: Mapping[str, float] = field(default_factory=dict)
    until: Tolerances | None = None


AnyStage = TypeVar("AnyStage", bound=Stage)
TermsAt = Callable[[dict[str, Any], AnyStage, int], Mapping[str, Term]]
"""State, stage and number of the step within the stage -> terms."""


def alternate(
    terms_at: "TermsAt[AnyStage]",
    start: Any,
    stages: Collection[AnyStage],
    *,
    steps: Steps | None = None,
    blocks: Collection[str] = (),
    callback: Callable[[int, Any, float], bool | None] | None = None,
) -> Minimized:
    """Go through the stages, each step being an accepted step of `minimize` on terms made at the
    state it starts from.

    terms_at: the terms at a state (values by name), their correspondences held. start: as `free` of
    `minimize`. steps: kind of steps, as an object of `habitus.solve.least_squares`;
    Levenberg-Marquardt without it. blocks: as in `minimize`. callback: (step, state, its cost)
    after each step; True stops.

    Returns what `minimize` does, of the last step: costs are those of its terms after it, history
    the cost before each step and the one after the last. status: "converged" (the last step was
    within its tolerances), "iterations" (all steps taken), "stalled" (the last step was refused),
    "stopped" (by the callback) or "not finite".
    """
    began = time.perf_counter()
    steps = Levenberg() if steps is None else steps
    history: list[float] = []
    solved: Minimized | None = None
    state = start
    for stage in stages:
        for k in range(stage.steps):
            values = state if isinstance(state, Mapping) else vars(state)
            solved = minimize(
                terms_at({n: v for n, v in values.items() if v is not None}, stage, k),
                state,
                steps,
                fixed=stage.fixed,
                masks=stage.masks,
                max_step=stage.max_step,
                max_iterations=REFUSALS,
                max_accepted=1,
                tolerances=stage.until or DEFAULT,
                blocks=[name for name in blocks if name not in stage.fixed],
                stretch=False,
            )
            state = solved.state
            history.append(solved.history[0])
            if callback is not None and callback(len(history), state, solved.cost):
                solved = replace(solved, status="stopped")
            if solved.status in ("stopped", "not finite"):
                return _ended(solved, history, began)
            if solved.cost == solved.history[0] and solved.status == "iterations":
                solved = replace(solved, status="stalled")
            if stage.until is not None and solved.status == "converged":
                break
    if solved is None:
        raise ValueError("the stages have no steps; expected at least one")
    return _ended(solved, history, began)


def _ended(solved: Minimized, history: list[float], began: float) -> Minimized:
    return replace(
        solved,
        iterations=len(history),
        history=(*history, solved.cost),
        seconds=time.perf_counter() - began,
    )
