"""Multi-start search: candidates, score, keep the best, refine, keep what differs.

    for each round:  refine the candidates by its step;  keep the ``keep`` cheapest of each group

Recipes whose cost has many minima begin here: a marker fit from plain poses, labelling and
discovery from poses in many headings, scans and depth views from poses in many turns. A group is
what one answer is sought for, such as a frame. Candidates are of any form; `rows` of them are
selected by the caller.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int

C = TypeVar("C")
S = TypeVar("S")


@dataclass(frozen=True)
class Round(Generic[S]):
    """A step of refinement (None: none), and how many candidates of each group go on after it
    (None: all).
    """

    step: S | None
    keep: int | None = None


def multi_start(
    candidates: C,
    rounds: Sequence[Round[S]],
    *,
    refine: Callable[[C, S], C],
    cost: Callable[[C], Float[np.ndarray, " N"]],
    select: Callable[[C, Int[np.ndarray, " n"]], C],
    groups: Callable[[C], Int[np.ndarray, " N"]],
) -> C:
    """The candidates left after all rounds, those of a group together and cheapest first wherever
    some were dropped.

    groups: which group each candidate is of. Costs are asked for only where candidates are dropped.
    """
    for each in rounds:
        if each.step is not None:
            candidates = refine(candidates, each.step)
        if each.keep is None:
            continue
        group = groups(candidates)
        if each.keep * len(np.unique(group)) < len(group):
            candidates = select(candidates, best_rows(cost(candidates), each.keep, group))
    return candidates


def best_rows(
    cost: Float[np.ndarray, " N"], keep: int, group: Int[np.ndarray, " N"] | None = None
) -> Int[np.ndarray, " n"]:
    """The rows of the ``keep`` cheapest of each group, cheapest first, groups in the order of their
    first rows; of equals the first.
    """
    if group is None:
        return np.argsort(cost, kind="stable")[:keep]
    chosen = []
    for number in dict.fromkeys(group.tolist()):
        rows = np.flatnonzero(group == number)
        chosen.append(rows[np.argsort(cost[rows], kind="stable")[:keep]])
    return np.concatenate(chosen)


def distinct_rows(
    cost: Float[np.ndarray, " N"], keep: int, alike: Callable[[int, int], bool]
) -> Int[np.ndarray, " n"]:
    """The ``keep`` cheapest rows of which none is like a cheaper one (``alike``: of two rows)."""
    chosen: list[int] = []
    for row in np.argsort(cost, kind="stable").tolist():
        if len(chosen) == keep:
            break
        if not any(alike(row, other) for other in chosen):
            chosen.append(row)
    return np.array(chosen, dtype=np.int64)


def best_of_tries(
    cost: Float[np.ndarray, " K *entries"], *tries: Float[np.ndarray, "K ..."]
) -> tuple[np.ndarray, ...]:
    """For each entry the values of its cheapest of K tries; tries: (K, *entries, ...)."""
    best = np.argmin(cost, axis=0)
    index = (best, *np.indices(best.shape))
    return tuple(each[index] for each in tries)
