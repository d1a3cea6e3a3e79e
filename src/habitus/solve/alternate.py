"""Iterated closest points and the like: terms made anew at each state, and a step down them.

    for each stage, for each step:    terms = terms_at(state)    state = a step of minimize(terms)

Correspondences, visibility and robust weights are held within a step, which is accepted only where
it lowers the cost of the terms it was made for. Trust region or damping carry over from step to
step.
"""

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from habitus.solve.least_squares import DEFAULT, Levenberg, Steps, Tolerances
from habitus.solve.minimize import Minimized, minimize
from habitus.solve.terms import Term

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
